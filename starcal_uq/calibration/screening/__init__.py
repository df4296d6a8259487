"""Wrong identifications, found before they do harm."""
