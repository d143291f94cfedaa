"""Training: frames, a sensor and a method in, Gaussians out."""

from obbgs_core.train.trainer import train

__all__ = ["train"]
