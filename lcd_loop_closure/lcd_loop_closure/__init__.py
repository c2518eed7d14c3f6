"""Answer "where have I been before, and how do I fix the map?" (thesis chapter 3)."""
