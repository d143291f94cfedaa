"""The light that the camera sees: Blender, the sensor, motion, stars, and the target that comes with the project."""

from pathlib import Path

SHIPPED = Path(__file__).parents[1] / "assets" / "spacecraft.glb"  # the target that comes with the project
