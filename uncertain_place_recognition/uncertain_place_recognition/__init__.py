"""Answer "which known place is this, and is that to be believed?" (thesis chapter 4)."""
