"""The cells of a grid: every session with every method, seed, budget and condition, and the digest of each."""

import dataclasses
import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from compare.case import content_digest
from compare.conditions import Condition
from compare.errors import CompareError
from compare.methods import Method, method
from ground.run.cluster import frames_mb, needed_mb
from ground.session.folder import open_session, pass_name
from ground.session.training_frames import TEST_INTERVAL

VALUE_BYTES = 16  # of a frame, of a method that holds them whole in single precision, with truth and pictures
TRUTH_BYTES = 8  # of a held-out frame, which is every eighth: its truth and a method's picture of it
FORMAT = 2  # of a cell's digest; raise it when what is scored changes its meaning


@dataclass(frozen=True)
class Budget:
    """What a training may use: a share of its method's own steps, and a largest number of Gaussians if not its own."""

    steps_share: float = 1.0
    largest: int | None = None

    def __str__(self) -> str:
        return f"{self.steps_share:g}" + ("" if self.largest is None else f"@{self.largest}")


def parse_budgets(text: str) -> list[Budget]:
    """Return the budgets in a text such as `1,0.5,1@8000`: shares of the steps, and after `@` the most Gaussians.

    Raises:
        ValueError: it is no such text.
    """
    budgets = []
    for part in text.split(","):
        share, at, largest = part.strip().partition("@")
        try:
            budget = Budget(float(share), int(largest) if at else None)
            if not 0 < budget.steps_share < 1e6 or (budget.largest is not None and budget.largest < 2):
                raise ValueError
        except ValueError as error:
            raise ValueError(
                "--budgets: expected shares of the steps above 0, each with @ and 2 or more Gaussians if wanted, "
                f"such as 1,0.5,1@8000; got {part!r}"
            ) from error
        budgets.append(budget)
    return budgets


@dataclass(frozen=True)
class SessionFacts:
    """What a grid knows of a session without holding its frames."""

    path: Path
    name: str
    digest: str
    size_px: int  # the longer side
    frames: int
    pixels: int  # of a frame, times its channels
    frames_mb: float  # memory that they are estimated to take in a training


def session_facts(folder: Path) -> SessionFacts:
    """Return the facts of a session.

    Raises:
        SessionError: it cannot be used.
    """
    session = open_session(folder)
    session.check_body_axes()
    camera = session.camera
    return SessionFacts(
        folder.resolve(),
        pass_name(folder),
        content_digest(folder),
        max(camera.width, camera.height),
        len(session.frames),
        camera.width * camera.height * camera.channels,
        frames_mb(session),
    )


@dataclass(frozen=True)
class Cell:
    """One row to be made. `memory_mb` is what its process is estimated to need; `weights` are a learned method's."""

    session: SessionFacts
    method: str
    seed: int
    budget: Budget
    condition_name: str
    condition: Condition
    digest: str
    memory_mb: float
    weights: Path | None = None

    @property
    def label(self) -> str:
        parts = [self.method, self.session.name, self.condition_name, f"seed {self.seed}", str(self.budget)]
        return ", ".join(parts)


def cells_of(
    sessions: Sequence[SessionFacts],
    methods: Sequence[str],
    seeds: int,
    budgets: Sequence[Budget],
    conditions: dict[str, Condition],
    weights: Path | None = None,
) -> list[Cell]:
    """Return the cells of a grid in the order in which they are worth having: first seeds and first conditions first.

    A cell stands once where axes mean nothing to its method: a black image has no seed, no steps and no size.
    Conditions with settings of a training hold only for methods that are trainings.

    Args:
        weights: the file of a learned method's weights.

    Raises:
        ValueError: no such method, no seed, or no weights where they are needed.
        CompareError: two sessions have one name or the same content.
    """
    if seeds < 1:
        raise ValueError(f"--seeds: expected 1 or more, got {seeds}")
    known: dict[str, Path] = {}
    for facts in sessions:
        for key in (facts.name, facts.digest):
            if key in known:
                same, way_out = ("content", "") if key == facts.digest else ("name", ", or rename its folder")
                raise CompareError(
                    f"{known[key]} and {facts.path} have the same {same}: leave one out{way_out}"
                )
            known[key] = facts.path
    registered = [method(name, weights) for name in dict.fromkeys(methods)]
    cells: dict[str, Cell] = {}
    for budget in budgets:
        for seed in range(seeds):
            for name, condition in conditions.items():
                for facts in sessions:
                    for wanted in registered:
                        if condition.set and not wanted.settable:
                            continue
                        cell = _cell(facts, wanted, seed, budget, name, condition)
                        cells.setdefault(cell.digest, cell)
    weights = None if weights is None else weights.resolve()
    return [dataclasses.replace(cell, weights=weights) for cell in cells.values()]


def _cell(
    facts: SessionFacts, wanted: Method, seed: int, budget: Budget, name: str, condition: Condition
) -> Cell:
    """Return a cell, with what means nothing to its method at the usual value."""
    seed = seed if wanted.seeded else 0
    share = budget.steps_share if wanted.stepped else 1.0
    largest = budget.largest if wanted.sized else None
    content = {
        "format": FORMAT,
        "session": facts.digest,
        "method": wanted.name,
        "stated": wanted.stated,
        "seed": seed,
        "steps_share": share,
        "largest": largest,
        "condition": condition.stated(),
    }
    digest = hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
    gaussians = wanted.gaussians if largest is None else largest
    values_mb = 1e-6 * facts.frames * facts.pixels
    held_mb = (
        facts.frames_mb + TRUTH_BYTES / TEST_INTERVAL * values_mb if gaussians else VALUE_BYTES * values_mb
    )
    memory_mb = needed_mb(held_mb, gaussians) + wanted.working_mb
    return Cell(facts, wanted.name, seed, Budget(share, largest), name, condition, digest, memory_mb)
