"""What the tests of the ground share: models with few points on their surface."""

from collections.abc import Iterator

import pytest


@pytest.fixture(autouse=True, scope="module")
def few_surface_points() -> Iterator[None]:
    """The 100,000 points of a surface cost half of a short run, and hardly any test measures how good they are."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("ground.run.model_files.SURFACE_POINTS", 2_000)
        patch.setattr("ground.run.evaluate.SURFACE_POINTS", 2_000)  # on the mesh
        yield
