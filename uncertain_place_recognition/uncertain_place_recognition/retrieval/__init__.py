"""Find the places of a map whose descriptors are most alike."""
