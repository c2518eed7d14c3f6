"""Judge networks on samples, and filters on drives: thesis section 5.3."""
