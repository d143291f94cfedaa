"""The attitude and rotation of a target about which nothing is known, from the outlines in the frames of a pass."""
