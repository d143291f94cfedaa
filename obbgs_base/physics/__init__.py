"""The Earth, stars, rotation of a free body, and how errors of navigation move the poses of a pass."""
