"""Learn how likely what the mutual repair puts in is right: the weights of `fusion.repair_odds`.

    python tools/learn_repair_odds.py

Of simulated drives (seed 5, two rigs of Xu2024) in homes 11 to 18 and 41 to 48, by the simulator's own
sensors and by those of `tools/second_sensors.py`, all that could be put in is compared with the truth: what
holds of one model of a sensor alone is not learned. What takes the place of a lidar's reading, and the mean,
are learned by the own sensors alone. Printed are the weights, and for homes 21 to 24 the predicted and
true shares. The repair is scored on other homes: `tools/repair_worth.py`.
"""

from __future__ import annotations

from argparse import ArgumentParser, RawDescriptionHelpFormatter
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray
from second_sensors import second_pairs
from xu2024_pairs import TruePair, simulate_pairs

import fusion
from fusion.denoise import find_candidates
from fusion.repair_odds import probabilities
from slam.simulation.drive import prepare_drive
from slam.simulation.home import generate_home
from slam.simulation.rigs import RIGS

RIG_NAMES = ("turtlebot_high", "xu2024")
RIGHT_BEAM_M, RIGHT_PIXEL_M = 0.2, 0.1
PIXEL_SHARE = 0.2  # of the pixels of holes: hundreds of them are of one wall
LEARNED, CHECKED, SEED, PAIRS = (*range(11, 19), *range(41, 49)), range(21, 25), 5, 14
BEAMS = ("camera in a hole", "line in a hole", "camera for a reading", "line for a reading", "mean of both")
PIXELS = ("lidar in a hole", "lidar for a reading")
_RIDGE = 1.0  # keeps weights finite that nothing determines
_ROUNDS = 30

Floats = NDArray[np.float64]
Samples = dict[str, tuple[Floats, NDArray[np.bool_]]]


def main() -> None:
    """Learn on some homes, check on others, print the table."""
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=int, default=PAIRS, help="most pairs a drive, evenly spread")
    arguments = parser.parse_args()
    learned, checked = (gather(homes, arguments.pairs) for homes in (LEARNED, CHECKED))
    print(table(learned))
    for kind, (features, right) in checked.items():
        weights = np.round(logistic(*learned[kind]), 2)
        predicted = probabilities(np.zeros(len(right), np.intp), features, weights[None])
        print(f"{kind}: {reliability(predicted, right)}")


def table(learned: Samples) -> str:
    """The weights as `fusion.repair_odds` has them."""
    lines = []
    for name, kinds in (("BEAM_ODDS", BEAMS), ("PIXEL_ODDS", PIXELS)):
        weights = np.array([np.round(logistic(*learned[kind]), 2) for kind in kinds])
        shown = np.array2string(weights, separator=", ", max_line_width=90, threshold=weights.size)
        lines.append(f"{name} = np.array({shown})\n")
    return "".join(lines)


def gather(homes: Sequence[int], pairs: int) -> Samples:
    """Features of all candidates of the drives in some homes, and whether they were right."""
    held: dict[str, list[tuple[Floats, NDArray[np.bool_]]]] = {kind: [] for kind in (*BEAMS, *PIXELS)}
    for seed in homes:
        home = generate_home(seed)
        for rig in RIG_NAMES:
            drive = prepare_drive(home, RIGS[rig], SEED)
            own = list(simulate_pairs(drive, pairs))
            for shown in (own, list(second_pairs(drive, own))):
                for kind, features, right in judged(shown):
                    if shown is own or kind not in BEAMS[2:]:
                        held[kind].append((features, right))
    return {
        kind: (np.concatenate([one for one, _ in parts]), np.concatenate([two for _, two in parts]))
        for kind, parts in held.items()
    }


def judged(pairs: Sequence[TruePair]) -> Iterator[tuple[str, Floats, NDArray[np.bool_]]]:
    """Candidates of the pairs of a drive, by kind: (N, K) features, and (N,) whether they are right."""
    rig = fusion.Rig()
    for pair in pairs:
        rig.add(fusion.register(pair.scan, [image.depth for image in pair.images]))
    estimate = rig.estimate()
    assert estimate is not None
    matrices = [None if found is None else found.T_laser_level for found in estimate.alignments]
    rng = np.random.default_rng(0)
    for pair in pairs:
        found = find_candidates(pair.scan, [image.depth for image in pair.images], estimate, matrices)
        truth = pair.true_ranges_m[:: 1 if pair.scan.step_rad > 0.0 else -1]
        for number, kind in enumerate(BEAMS):
            side, beam = np.nonzero(found.kinds == number)
            rows = found.beams[side, beam]
            yield kind, rows[:, 1:], np.abs(rows[:, 0] - truth[beam]) <= RIGHT_BEAM_M
        for camera, rows in found.pixels.items():
            true_m = pair.images[camera].true_depth_m.ravel()[rows[:, 0].astype(int)]
            chosen = (rows[:, 1] == 1) | (rng.random(len(rows)) < PIXEL_SHARE)
            for number, kind in enumerate(PIXELS):
                own = chosen & (rows[:, 1] == number)
                yield kind, rows[own, 3:], np.abs(rows[own, 2] - true_m[own]) <= RIGHT_PIXEL_M


def logistic(features: Floats, right: NDArray[np.bool_]) -> Floats:
    """Weights of one, the features and their products that make the outcomes likeliest: Newton's method."""
    one = np.insert(features, 0, 1.0, axis=1)
    rows, cols = np.triu_indices(one.shape[1])
    inputs = one[:, rows] * one[:, cols]
    weights, kind = np.zeros(inputs.shape[1]), np.zeros(len(right), np.intp)
    for _ in range(_ROUNDS):
        chance = probabilities(kind, features, weights[None])
        gradient = inputs.T @ (right - chance) - _RIDGE * weights
        curvature = (inputs * (chance * (1.0 - chance))[:, None]).T @ inputs + _RIDGE * np.eye(weights.size)
        weights += np.linalg.solve(curvature, gradient)
    return weights


def reliability(predicted: Floats, is_right: NDArray[np.bool_]) -> str:
    """Mean predicted probability and true share for each tenth of the range, with the number of values."""
    tenth = np.minimum((10.0 * predicted).astype(int), 9)
    parts = [tenth == number for number in range(10)]
    return ", ".join(
        f"{predicted[own].mean():.2f} {is_right[own].mean():.2f} ({own.sum()})" for own in parts if own.any()
    )


def by_rank(predicted: Floats, is_right: NDArray[np.bool_]) -> str:
    """Mean predicted probability and true share of each tenth of the values, the least likely first."""
    parts = np.array_split(np.argsort(predicted), 10)
    return ", ".join(f"{predicted[own].mean():.3f} {is_right[own].mean():.3f}" for own in parts if own.size)


if __name__ == "__main__":
    main()
