"""The light that the camera sees: Blender, the sensor, motion, stars, and the target that comes with the project."""

from pathlib import Path
from typing import Literal

Materials = Literal["own", "foil"]  # those of the mesh, or crinkled foil and cell glass in their place
SHIPPED = Path(__file__).parents[1] / "assets" / "spacecraft.glb"  # the target that comes with the project
SHIPPED_FOIL = SHIPPED.with_name(
    "spacecraft-foil.glb"
)  # the same in crinkled foil, cell glass and polished metal
