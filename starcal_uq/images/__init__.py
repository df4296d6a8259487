"""From pixels to centroids."""
