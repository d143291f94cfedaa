"""The simulated world around flight and ground."""

from pathlib import Path

SHIPPED = Path(__file__).parent / "assets" / "spacecraft.glb"  # the target that comes with the project
