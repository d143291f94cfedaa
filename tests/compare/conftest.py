"""What the tests of comparisons share with those of the ground: models with few points on their surface."""

from tests.ground.conftest import few_surface_points

__all__ = ["few_surface_points"]
