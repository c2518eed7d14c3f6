"""Judge loop detectors and registrations by the thesis's protocols (section 3.3), on any drive."""
