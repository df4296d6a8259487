"""Before any data: forecasts and designs."""
