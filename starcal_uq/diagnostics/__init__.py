"""What questions a result."""
