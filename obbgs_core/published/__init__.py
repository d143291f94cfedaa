"""What published methods do otherwise than `obbgs`: settings, and functions that a training calls where asked to."""
