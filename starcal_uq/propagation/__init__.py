"""What a posterior means: couplings, attitude errors, maps over the field."""
