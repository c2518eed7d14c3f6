"""CMRNet and its uncertain variants (thesis chapter 5)."""
