"""Poses that err: their corrections, what pictures say of them, and what they leave open."""
