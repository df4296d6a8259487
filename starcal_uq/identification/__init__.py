"""Which catalogue star each centroid is."""
