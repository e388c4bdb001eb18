"""The main loop on logs where something goes wrong, and with loops that are false."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pipeline_runs import (
    SCAN_STEP_M,
    edited,
    errors_m,
    line_numbers,
    long_log,
    mapped,
    moved,
    run,
    short_log,
    stamp,
    wheel_rows,
    with_stamp,
)

from slam.config import Config, load_config
from slam.datasets import open_dataset
from slam.datasets.carmen_records import WRONG_COUNT
from slam.errors import DatasetError
from slam.estimates import MotionEstimate
from slam.graph.edge import EdgeKind
from slam.graph.loop_candidate import LoopCandidate
from slam.mapper.lidar2d import PlanarRobot
from slam.mapper.map_result import MapResult
from slam.mapper.mapper import Mapper
from slam.mapping.occupancy_grid import OCCUPIED
from slam.matching.planar import between, compose
from slam.measurements import FloatArray, pose2_from_row
from slam.outputs.exports import Exports
from slam.simulation.synthetic_log import SyntheticLog

__all__ = ["long_log", "mapped", "short_log"]  # fixtures


class TestMishaps:
    """Logs that are wrong in one way each."""

    def test_odometry_that_jumps_once(self, short_log: SyntheticLog, tmp_path: Path) -> None:
        def jump(number: int, fields: list[str]) -> Iterable[list[str]]:
            yield moved(fields, 5.0 if stamp(fields) > 1009.95 else 0.0)

        log = edited(short_log, tmp_path / "jump.log", jump)
        assert np.abs(np.diff(wheel_rows(log)[:, 0])).max() > 4.0
        errors = errors_m(run(log), short_log.truth.to_planar())
        assert errors[::2].max() < 0.03
        assert errors.max() < SCAN_STEP_M  # the reading between two scans that the jump is in

    def test_scans_only(self, short_log: SyntheticLog, tmp_path: Path) -> None:
        def raw(number: int, fields: list[str]) -> Iterable[list[str]]:
            if fields[0] == "FLASER":
                beams = int(fields[1])
                head = f"RAWLASER1 0 {-math.pi / 2} {math.pi} {math.pi / (beams - 1)} 30.0 0.01 0 {beams}"
                yield [*head.split(), *fields[2 : 2 + beams], "0", *fields[-3:]]

        log = edited(short_log, tmp_path / "raw.log", raw)
        assert not wheel_rows(log).size
        result = run(log)
        kinds = {factor.edge.kind for factor in result.map.factors}
        assert EdgeKind.LIDAR in kinds and EdgeKind.WHEEL not in kinds
        assert errors_m(result, short_log.truth.to_planar()[::2]).max() < 0.03

    def test_wheels_that_never_report_a_turn(self, short_log: SyntheticLog, tmp_path: Path) -> None:
        def frozen(number: int, fields: list[str]) -> Iterable[list[str]]:
            if fields[0] == "FLASER":
                yield [*fields[:-9], *["0"] * 6, *fields[-3:]]

        result = run(edited(short_log, tmp_path / "frozen.log", frozen))
        assert errors_m(result, short_log.truth.to_planar()[::2]).max() < 0.1

    def test_poses_in_the_scan_lines_are_odometry(self, short_log: SyntheticLog, tmp_path: Path) -> None:
        def scans(number: int, fields: list[str]) -> Iterable[list[str]]:
            if fields[0] == "FLASER":
                yield fields

        log = edited(short_log, tmp_path / "scans.log", scans)
        result = run(log)
        assert EdgeKind.WHEEL in {factor.edge.kind for factor in result.map.factors}
        assert errors_m(result, short_log.truth.to_planar()[::2]).max() < 0.03

    def test_scans_only_with_a_gap_claim_no_more_than_is_known(
        self, short_log: SyntheticLog, tmp_path: Path
    ) -> None:
        """Nothing shows whether the robot is back where it was, or at a place that looks the same."""

        def gap(number: int, fields: list[str]) -> Iterable[list[str]]:
            if not 1004.0 < stamp(fields) < 1012.0:
                yield fields

        log = edited(short_log, tmp_path / "gap.log", gap)
        result = run(log, "sensors.wheels=false")
        trajectory, covariances = result.map.trajectory, result.map.covariances
        assert covariances is not None
        after_s = trajectory.stamps_s - trajectory.stamps_s[0]
        sigmas_m = np.sqrt(covariances[:, [0, 1], [0, 1]])
        assert sigmas_m[after_s < 3.5].max() < 0.05 and sigmas_m[after_s > 12.0].min() > 1.0

    def test_odometry_only(self, short_log: SyntheticLog, tmp_path: Path) -> None:
        log = edited(
            short_log, tmp_path / "wheels.log", lambda number, fields: [fields] * (fields[0] == "ODOM")
        )
        with pytest.raises(DatasetError, match="wheels contains no scan or frame"):
            run(log)

    def test_scans_that_cannot_be_read_are_reported_with_the_reason(
        self, short_log: SyntheticLog, tmp_path: Path
    ) -> None:
        def cut(number: int, fields: list[str]) -> Iterable[list[str]]:
            yield fields[:-4] if fields[0] == "FLASER" and (number % 5 or every) else fields

        for every in (False, True):
            log = edited(short_log, tmp_path / "cut.log", cut)
            if not every:
                (stated,) = (one for one in run(log).warnings if "are mapped" in one)
                assert "scans or frames are mapped" in stated and f"x {WRONG_COUNT}" in stated
        with pytest.raises(DatasetError, match=rf"can be mapped \(\d+ x {WRONG_COUNT}"):
            run(log)

    def test_in_the_open_the_wheels_carry_on(self, short_log: SyntheticLog, tmp_path: Path) -> None:
        def blind(number: int, fields: list[str]) -> Iterable[list[str]]:
            beams = int(fields[1]) if fields[0] == "FLASER" else 0
            yield [*fields[:2], *["30.000"] * beams, *fields[2 + beams :]] if beams else fields

        log = edited(short_log, tmp_path / "open.log", blind)
        result = run(log)
        assert errors_m(result, wheel_rows(log)).max() < 1e-6
        assert {factor.edge.kind for factor in result.map.factors} == {EdgeKind.WHEEL}
        assert np.isnan(result.scans.inlier_shares).all()
        assert result.map.grid is None or not (result.map.grid.states() == OCCUPIED).any()
        still = run(log, "sensors.wheels=false")
        assert {factor.edge.kind for factor in still.map.factors} <= {EdgeKind.ASSUMED}
        assert len(still.map.trajectory) == len(result.map.trajectory)

    def test_blind_for_a_while(self, short_log: SyntheticLog, tmp_path: Path) -> None:
        def blind(number: int, fields: list[str]) -> Iterable[list[str]]:
            beams = int(fields[1]) if fields[0] == "FLASER" and 1008.0 < stamp(fields) < 1011.0 else 0
            yield [*fields[:2], *["30.000"] * beams, *fields[2 + beams :]] if beams else fields

        result = run(edited(short_log, tmp_path / "blind.log", blind))
        assert errors_m(result, short_log.truth.to_planar()).max() < 0.05
        assert np.isnan(result.scans.inlier_shares[1:]).sum() == 14

    def test_a_jump_while_blind_is_not_driven(self, short_log: SyntheticLog, tmp_path: Path) -> None:
        def blind(number: int, fields: list[str]) -> Iterable[list[str]]:
            now = moved(fields, 20.0 if stamp(fields) > 1007.95 else 0.0)
            beams = int(fields[1]) if fields[0] == "FLASER" and 1007.0 < stamp(fields) < 1009.0 else 0
            yield [*now[:2], *["30.000"] * beams, *now[2 + beams :]] if beams else now

        result = run(edited(short_log, tmp_path / "blind.log", blind))
        assert errors_m(result, short_log.truth.to_planar())[::2].max() < 1.0

    @pytest.mark.parametrize("wheels", ["true", "false"])
    def test_a_clock_that_is_set_back(self, short_log: SyntheticLog, tmp_path: Path, wheels: str) -> None:
        def set_back(number: int, fields: list[str]) -> Iterable[list[str]]:
            yield with_stamp(fields, stamp(fields) - (8.0 if stamp(fields) > 1009.95 else 0.0))

        log = edited(short_log, tmp_path / "set_back.log", set_back)
        result = run(log, f"sensors.wheels={wheels}")
        assert np.diff(result.map.trajectory.stamps_s).min() < -7.0
        errors = errors_m(result, short_log.truth.to_planar())
        assert errors[::2].max() < 0.03
        assert errors.max() < SCAN_STEP_M  # without wheels nobody knows when a reading amid the step was

    @pytest.mark.parametrize("wheels", ["true", "false"])
    def test_a_clock_that_runs_backward(self, short_log: SyntheticLog, tmp_path: Path, wheels: str) -> None:
        def backward(number: int, fields: list[str]) -> Iterable[list[str]]:
            yield with_stamp(fields, 2000.0 - stamp(fields))

        log = edited(short_log, tmp_path / "backward.log", backward)
        result = run(log, f"sensors.wheels={wheels}")
        assert (np.diff(result.map.trajectory.stamps_s) <= 0.0).all()
        errors = errors_m(result, short_log.truth.to_planar())
        assert errors[::2].max() < 0.03
        assert errors.max() < (0.03 if wheels == "true" else SCAN_STEP_M)

    def test_a_gap_that_the_wheels_bridge(self, short_log: SyntheticLog, tmp_path: Path) -> None:
        def gap(number: int, fields: list[str]) -> Iterable[list[str]]:
            if fields[0] == "ODOM" or not 1006.0 < stamp(fields) < 1009.0:
                yield fields

        result = run(edited(short_log, tmp_path / "gap.log", gap))
        assert errors_m(result, short_log.truth.to_planar()).max() < 0.25
        assert errors_m(result, short_log.truth.to_planar())[-1] < 0.1

    @pytest.mark.parametrize(
        ("took_s", "stated"),
        [
            (10.0, "No scan or image was matched"),
            (0.0, "At 4.4 s a scan does not match what was seen there before (1 such scans)"),
        ],
    )
    def test_a_robot_carried_away_unseen(
        self, short_log: SyntheticLog, tmp_path: Path, took_s: float, stated: str
    ) -> None:
        stamps = np.round(short_log.truth.stamps_s, 6)
        wheels = wheel_rows(short_log.log_path)
        before, after = (int(np.searchsorted(stamps, s)) for s in (1003.95, 1013.95))

        def carried(number: int, fields: list[str]) -> Iterable[list[str]]:
            index = int(np.searchsorted(stamps, stamp(fields)))
            if index < before:
                yield fields
            elif index >= after:
                # The wheels did not turn meanwhile.
                pose = compose(wheels[before - 1], between(wheels[after], wheels[index]))
                row = [f"{value:.6f}" for value in pose]
                fields = with_stamp(fields, stamp(fields) - 10.0 + took_s)
                if fields[0] == "ODOM":
                    yield [fields[0], *row, *fields[4:]]
                else:
                    yield [*fields[:-9], *row, *row, *fields[-3:]]

        result = run(edited(short_log, tmp_path / "carried.log", carried))
        assert any(stated in warning for warning in result.warnings)
        readings = line_numbers(result)
        assert readings[-1] + 1 == len(stamps) - (after - before)
        assert np.isfinite(result.map.trajectory.positions_m).all()
        # Where it woke up nobody can show; what it drove there, the lidar measured.
        tail = result.map.trajectory.to_planar()[readings >= before]
        truth = short_log.truth.to_planar()[after:]
        drove, true = between(tail[0], tail[-1]), between(truth[0], truth[-1])
        assert math.hypot(*(drove - true)[:2]) < 0.1

    def test_a_single_scan(self, short_log: SyntheticLog, tmp_path: Path) -> None:
        path = tmp_path / "one.log"
        lines = [line for line in short_log.log_path.read_text().splitlines() if line.startswith("FLASER")]
        path.write_text(lines[0] + "\n")
        result = run(path)
        assert len(result.map.keyframe_poses) == 1
        np.testing.assert_array_equal(result.map.trajectory.to_planar(), np.zeros((2, 3)))
        assert result.map.grid is not None
        Exports(result.map, Config()).write_files(tmp_path)

    def test_a_robot_that_stands_still(self, short_log: SyntheticLog, tmp_path: Path) -> None:
        lines = [line for line in short_log.log_path.read_text().splitlines() if line.startswith("FLASER")]
        fields = lines[0].split()
        path = tmp_path / "still.log"
        path.write_text("\n".join(" ".join(with_stamp(fields, 1000.0 + 0.2 * n)) for n in range(20)) + "\n")
        result = run(path)
        assert len(result.map.keyframe_poses) == 1
        assert np.abs(result.map.trajectory.to_planar()).max() < 1e-3


@pytest.fixture(scope="module", params=["apart", "in a row"])
def bent(
    long_log: SyntheticLog, mapped: MapResult, request: pytest.FixtureRequest
) -> tuple[MapResult, list[LoopCandidate]]:
    mapper = Mapper(load_config(), PlanarRobot(load_config()))
    for measurement in open_dataset(long_log.log_path):
        mapper.add(measurement)
    model = next(loop.motion for loop in mapped.map.loops if loop.accepted and loop.motion)
    false = list(_false_loops(mapped.map.keyframe_poses, model, request.param))
    for loop in false:
        mapper.add_loop(loop)
    return mapper.finish(), false


class TestFalseLoops:
    """Mapper.add_loop takes any candidate; the final optimisation decides."""

    def test_they_do_not_bend_the_map(
        self, bent: tuple[MapResult, list[LoopCandidate]], mapped: MapResult, long_log: SyntheticLog
    ) -> None:
        truth = long_log.truth.to_planar()
        assert errors_m(bent[0], truth).mean() < 1.1 * errors_m(mapped, truth).mean()

    def test_each_is_named_with_its_reason(
        self, bent: tuple[MapResult, list[LoopCandidate]], mapped: MapResult
    ) -> None:
        result, false = bent
        named = result.map.loops[-len(false) :]
        assert [(loop.place, loop.keyframe) for loop in named] == [(lo.place, lo.keyframe) for lo in false]
        assert {(loop.accepted, loop.reason) for loop in named} == {
            (False, "disagrees with the other loops (GNC)")
        }
        ours, before = (sum(loop.accepted for loop in one.map.loops) for one in (result, mapped))
        assert ours == before


def _false_loops(poses: FloatArray, model: MotionEstimate, order: str) -> Iterable[LoopCandidate]:
    """Ten loops that say of places far apart that they are the same, as surely as a true one.

    Apart, each stands alone; in a row, five at a time agree with each other.
    """
    rng = np.random.default_rng(0)
    for number in range(10):
        place, keyframe = 5 + number, len(poses) - 90 + 3 * number
        claim = rng.normal(0.0, [0.2, 0.2, 0.1])
        if order == "in a row":
            first = number - number % 5
            place, start = 5 + first, len(poses) - 90 + 3 * first
            claim = between(poses[start], poses[keyframe])
        wrong = between(compose(poses[place], claim), poses[keyframe])
        assert math.hypot(*wrong[:2]) > 1.0
        motion = replace(model, T_reference_base=pose2_from_row(claim))
        yield LoopCandidate(place, keyframe, 1.0, 0.3, 0.9, motion, True, "")
