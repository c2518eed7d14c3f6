"""Look at a drive afterwards: numbers, pictures, one page to read."""
