"""Where stars are seen: catalogues, apparent places, sites, refraction."""
