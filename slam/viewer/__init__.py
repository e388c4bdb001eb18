"""What the rerun viewer shows."""
