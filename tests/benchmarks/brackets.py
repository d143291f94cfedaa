"""What it costs and brings to spread the exposures of a bracket over the time until the next one.

As many frames of the same exposures are taken in brackets whose frames are half a second apart (`tight`), and evenly
over the pass: then the tags of each frame err by themselves (`spread`), or those of a bracket alike and have one
correction (`spread, one error a bracket`). All are scored on the same further views, at random times of the pass, that
no training sees.

    python -m tests.benchmarks.brackets --json
"""

import argparse
import itertools

import numpy as np
import torch

from hil.world.scenario import load_scenario
from obbgs_core.methods.config import MethodConfig
from obbgs_core.methods.presets import preset
from tests.benchmarks import passes, poses
from tests.benchmarks.rows import shown

VIEWS = 48  # to score on
LAYOUTS = ("tight", "spread", "spread, one error a bracket")


def pass_of(
    layout: str, target: int, scenario_name: str, brackets: int, size_px: int, seed: int
) -> passes.Pass:
    """Return a pass with the views to score on, which are held out, in the order of time."""
    scenario, count = load_scenario(scenario_name), brackets * len(passes.EXPOSURES_S)
    gap_s = scenario.duration_s / (count - 1)
    tight = passes.bracket_times_s(scenario, brackets)
    times_s = tight if layout == "tight" else gap_s * np.arange(count)
    of_bracket = np.arange(count) if layout == "spread" else np.arange(count) // len(passes.EXPOSURES_S)
    scored_s = np.sort(np.random.default_rng(7).uniform(0, scenario.duration_s, VIEWS))
    order = np.argsort(np.concatenate([times_s, scored_s]), kind="stable")
    exposures = np.resize(passes.EXPOSURES_S, count)
    return passes.taken(
        target,
        scenario,
        np.concatenate([times_s, scored_s])[order],
        np.concatenate([exposures, np.resize(passes.EXPOSURES_S, VIEWS)])[order].tolist(),
        np.concatenate([of_bracket, count + np.arange(VIEWS)])[order].tolist(),
        np.flatnonzero(order >= count).tolist(),
        size_px,
        seed,
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    names = (*poses.SCENARIOS, *poses.BY_BASILISK)
    parser.add_argument("--scenarios", nargs="+", choices=names, default=list(poses.SCENARIOS))
    parser.add_argument("--layouts", nargs="+", choices=LAYOUTS, default=list(LAYOUTS))
    parser.add_argument(
        "--conditions", nargs="+", choices=poses.CONDITIONS, default=["exact", "correlated_1"]
    )
    parser.add_argument("--targets", nargs="+", type=int, default=[0], help="seeds of bodies of boxes")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--brackets", type=int, default=35)
    parser.add_argument("--size", type=int, default=64, help="pixels along a side")
    parser.add_argument("--steps", type=int, default=600)
    parser.add_argument("--json", action="store_true", help="print rows as JSON lines")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    config: MethodConfig = preset("obbgs", {"steps": arguments.steps})
    for seed, target, scenario, layout in itertools.product(
        arguments.seeds, arguments.targets, arguments.scenarios, arguments.layouts
    ):
        seen = pass_of(layout, target, scenario, arguments.brackets, arguments.size, seed)
        for condition in arguments.conditions:
            row = {
                "method": layout,
                "condition": condition,
                "scenario": scenario,
                "target": f"boxes-{target}",
            }
            row |= {"seed": seed, "frames": len(seen.frames) - VIEWS, "size_px": arguments.size}
            figures = poses.scored(seen, condition, config, seed)
            print(shown(row | figures, "brackets", arguments.json), flush=True)


if __name__ == "__main__":
    main()
