"""Judge place recognition and its uncertainty, by the rules of the PointNetVLAD benchmark."""
