"""Scores of a model: image metrics, surface points, distances of point clouds."""
