"""What the mutual repair is worth, reading by reading and without conditions, and whether it knows.

    python tools/repair_worth.py --homes 31 32 33 34 [--rigs xu2024] [--seed 5] [--pairs 40] [--second]

Of simulated drives: how much of what was put in is off (a range by more than 0.2 m, a depth by more than 0.1
m), how many holes were filled rightly, of all and of those for which anything right was at hand, what became
of readings that were replaced; then the probabilities of the repair against the true shares, for all that can
have been put in, and for each tenth of what was filled. Intervals (95 %) are by drawing the pairs anew.
`--second` takes the sensors of `tools/second_sensors.py` instead of the simulator's own.
"""

from __future__ import annotations

from argparse import ArgumentParser, RawDescriptionHelpFormatter
from collections import defaultdict
from collections.abc import Iterable, Sequence

import numpy as np
from learn_repair_odds import RIGHT_BEAM_M, RIGHT_PIXEL_M, by_rank, reliability
from numpy.typing import NDArray
from second_sensors import second_pairs
from xu2024_pairs import TruePair, simulate_pairs

import fusion
from slam.simulation.drive import prepare_drive
from slam.simulation.home import generate_home
from slam.simulation.rigs import RIGS

_WORSE_M = 0.05
_DRAWS = 500
_INVENTED = (fusion.Provenance.FILLED, fusion.Provenance.INTERPOLATED)

Floats = NDArray[np.float64]


class Worth:
    """The readings of some pairs: counts by name and pair, and the probability of each."""

    def __init__(self) -> None:
        self.counts: dict[str, list[int]] = defaultdict(list)
        self.odds: dict[str, list[tuple[Floats, Floats, Floats]]] = defaultdict(list)

    def add(self, pair: TruePair, estimate: fusion.RigEstimate) -> None:
        """Repair a pair as usual, and with all that could be put in."""
        images = [image.depth for image in pair.images]
        usual = fusion.denoise(pair.scan, images, estimate)
        all_of_it = fusion.denoise(pair.scan, images, estimate, least_probability=0.0)
        given = pair.scan.valid_ranges_m()
        sides = [("beam", given, pair.true_ranges_m, pair.scan.range_max_m, RIGHT_BEAM_M,
                  [(one.ranges_m, one.lidar_source, one.lidar_probability, one.lidar_sigma_m)
                   for one in (usual, all_of_it)])]  # fmt: skip
        for k, image in enumerate(pair.images):
            depth = np.where(image.depth.depth_m > 0.0, image.depth.depth_m, np.nan)
            results = [(one.depth_m[k], one.depth_source[k], one.depth_probability[k], one.depth_sigma_m[k])
                       for one in (usual, all_of_it)]  # fmt: skip
            reach_m = image.depth.range_max_m
            sides.append(("pixel", depth, image.true_depth_m, reach_m, RIGHT_PIXEL_M, results))
        totals: dict[str, int] = defaultdict(int)
        for name, before, truth, reach_m, right_m, (kept, possible) in sides:
            self._side(totals, name, (before, truth), reach_m, right_m, kept, possible)
        for name, count in totals.items():
            self.counts[name].append(count)

    def _side(self, totals, name, readings, reach_m, right_m, kept, possible) -> None:  # type: ignore[no-untyped-def]
        """One scan or image: readings before, the truth, and both repairs."""
        before, truth = readings
        with np.errstate(invalid="ignore"):
            off = [np.abs(one[0] - truth) for one in (kept, possible)]
            was = np.abs(before - truth)
        hole = np.isnan(before)
        new = np.isin(kept[1], _INVENTED)
        self.odds[f"{name} filled"].append(
            tuple(value[new & hole].astype(float) for value in (kept[2], off[0], kept[3]))
        )
        for what, own in (("filled", new & hole), ("replaced", new & ~hole)):
            totals[f"{name} {what}"] += int(own.sum())
            totals[f"{name} {what} off"] += int((own & ~(off[0] <= right_m)).sum())
        totals[f"{name} replaced was off"] += int((new & (was > right_m)).sum())
        totals[f"{name} replaced worse"] += int((new & (off[0] > was + _WORSE_M)).sum())
        totals[f"{name} replaced better"] += int((new & (off[0] < was - _WORSE_M)).sum())
        totals[f"{name} holes"] += int((hole & (truth <= reach_m)).sum())
        totals[f"{name} holes right"] += int((new & hole & (off[0] <= right_m)).sum())
        totals[f"{name} right at hand"] += int(
            (np.isin(possible[1], _INVENTED) & hole & (off[1] <= right_m)).sum()
        )
        gone = (kept[1] == fusion.Provenance.HOLE) & ~hole
        totals[f"{name} dropped"] += int(gone.sum())
        totals[f"{name} dropped good"] += int((gone & (was <= right_m)).sum())
        for kind, own in ((name, np.isin(possible[1], _INVENTED)),
                          (f"{name} mean", possible[1] == fusion.Provenance.AVERAGED)):  # fmt: skip
            self.odds[kind].append(
                tuple(value[own].astype(float) for value in (possible[2], off[1], possible[3]))
            )


def share(worth: Worth, part: str, whole: str) -> str:
    """A share of counts with its interval over the pairs."""
    parts, wholes = np.array(worth.counts[part]), np.array(worth.counts[whole])
    if not wholes.sum():
        return "none"
    draws = np.random.default_rng(0).integers(parts.size, size=(_DRAWS, parts.size))
    drawn = parts[draws].sum(axis=1) / np.maximum(wholes[draws].sum(axis=1), 1)
    low, high = np.percentile(drawn, [2.5, 97.5])
    return f"{parts.sum() / wholes.sum():.4f} ({low:.4f} to {high:.4f}) of {wholes.sum()}"


_SHARES = {
    "filled holes off": ("filled off", "filled"),
    "replaced readings off": ("replaced off", "replaced"),
    "off before": ("replaced was off", "replaced"),
    "worse by 5 cm": ("replaced worse", "replaced"),
    "better by 5 cm": ("replaced better", "replaced"),
    "holes filled rightly": ("holes right", "holes"),
    "of those where right was at hand": ("holes right", "right at hand"),
    "dropped readings that were good": ("dropped good", "dropped"),
}


def print_figures(title: str, worth: Worth) -> None:
    """Print the figures: a table of shares, and the calibration of the probabilities."""
    print(f"| {title} | ranges | depths |\n|---|---|---|")
    for label, (part, whole) in _SHARES.items():
        cells = (share(worth, f"{name} {part}", f"{name} {whole}") for name in ("beam", "pixel"))
        print(f"| {label} | {' | '.join(cells)} |")
    print()
    for name, right_m in (("beam", RIGHT_BEAM_M), ("pixel", RIGHT_PIXEL_M)):
        for kind in (name, f"{name} mean"):
            odds, err, sigma = (np.concatenate(column) for column in zip(*worth.odds[kind], strict=True))
            right = err <= right_m
            if odds.size:
                print(f"{kind}: predicted, true: {reliability(odds, right)}")
                inside = [f"{np.mean(err[right] <= times * sigma[right]):.2f}" for times in (1.0, 2.0)]
                print(f"{kind}: right ones within one and two sigma: {', '.join(inside)}", flush=True)
        odds, err, _ = (np.concatenate(column) for column in zip(*worth.odds[f"{name} filled"], strict=True))
        print(f"{name} filled, tenths of them: predicted, true: {by_rank(odds, err <= right_m)}", flush=True)


def of_pairs(pairs: Sequence[TruePair], worth: Worth) -> None:
    """Two passes, as an offline mapper takes them."""
    rig = fusion.Rig()
    for pair in pairs:
        rig.add(fusion.register(pair.scan, [image.depth for image in pair.images]))
    estimate = rig.estimate()
    assert estimate is not None
    for pair in pairs:
        worth.add(pair, estimate)


def main() -> None:
    """Measure some homes."""
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("--homes", type=int, nargs="+", default=[31, 32, 33, 34])
    parser.add_argument("--rigs", nargs="+", default=["xu2024"])
    parser.add_argument("--seed", type=int, default=5)
    parser.add_argument("--pairs", type=int, default=40, help="most pairs a drive, evenly spread")
    parser.add_argument("--second", action="store_true", help="the second model of the sensors")
    arguments = parser.parse_args()
    worth = Worth()
    for home in arguments.homes:
        for rig in arguments.rigs:
            drive = prepare_drive(generate_home(home), RIGS[rig], arguments.seed)
            pairs: Iterable[TruePair] = simulate_pairs(drive, arguments.pairs)
            of_pairs(list(second_pairs(drive, pairs) if arguments.second else pairs), worth)
    print_figures(
        f"homes {arguments.homes}, {arguments.rigs}, {'second' if arguments.second else 'own'} faults", worth
    )


if __name__ == "__main__":
    main()
