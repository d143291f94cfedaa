"""What each part of a method contributes, one taken away (or added) at a time: python -m tests.benchmarks.ablation"""

import argparse

import torch

from tests.benchmarks import targets
from tests.benchmarks.methods import configure, measure
from tests.benchmarks.rows import shown

OURS: dict[str, dict] = {
    "as it is": {},
    "- exposure known": {"exposure_aware": False},
    "- sensor likelihood": {"loss.kind": "l1_ssim", "loss.ssim_weight": 0.2, "loss.edge_weight": 0.2},
    "- Sobel": {"loss.edge_weight": 0.0},
    "- bracket steps": {"bracket_steps": False},
    "- visual hull": {"start.kind": "random"},
    "- OBB growth": {"growth.obb_interval": 0},
    "- Pixel-GS weights": {"growth.pixel_weighted": False},
    "- pyramid": {"pyramid": ((0.0, 1.0),)},
    "- pruning by BIC": {"parsimony.prune_at": ()},
    "- harmonics by BIC": {"light.max_sh_degree": 0},
    "- flattening": {"loss.flat_weight": 0.0},
    "- falling rates": {"rates.final_share": 1.0},
    "- growth": {"growth.end": 0.0},
    "+ outlier filter": {"outlier_filter": True},
    "+ degree 1 from the start": {"light.sh_degree": 1},
    "+ pose refinement": {"poses.refine": "always"},
}

PUBLISHED: dict[str, dict] = {
    "as it is": {},
    "- Sobel": {"loss.edge_weight": 0.0},
    "- OBB growth": {"growth.obb_interval": 0},
    "- bracket steps": {"bracket_steps": False},
    "one frame a step": {"bracket_steps": False, "frames_per_step": 1},
    "- Pixel-GS weights": {"growth.pixel_weighted": False},
    "- outlier filter": {"outlier_filter": False},
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", action="store_true", help="one JSON object a row")
    parser.add_argument("--method", choices=("obbgs", "jiang2025"), default="obbgs")
    parser.add_argument("--targets", default="all", help="comma-separated names, or all")
    parser.add_argument("--size", type=int, default=400)
    parser.add_argument("--steps-share", type=float, default=1.0)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--only", help="comma-separated rows, by name")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    for target_name in targets.names() if arguments.targets == "all" else arguments.targets.split(","):
        target = targets.load(target_name, arguments.size)
        for name, changes in (OURS if arguments.method == "obbgs" else PUBLISHED).items():
            if arguments.only and name not in arguments.only.split(","):
                continue
            config = configure(arguments.method, arguments.steps_share, changes)
            row = {"method": arguments.method, "ablation": name} | measure(config, target, 0)
            print(shown(row, "ablation", arguments.json), flush=True)


if __name__ == "__main__":
    main()
