"""Judge loops by the reference: which are true, which are false, which were missed."""

from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from lcd_common import se3
from lcd_common.settings import config, setting
from lcd_common.trajectory import Trajectory
from lcd_loop_closure.loop import LoopConstraint
from lcd_loop_closure.revisits import true_loops


@config
class LoopJudgementConfig:
    """When a loop counts as true."""

    max_translation_error: float = setting(1.0, 'of a true loop', unit='m', low=0.0)
    max_rotation_error: float = setting(3.0, 'of a true loop', unit='deg', low=0.0)


class Verdict(Enum):
    """What the reference says of a candidate."""

    TRUE = 'true'  # accepted, and right
    FALSE = 'false'  # accepted, and wrong
    REJECTED = 'rejected'
    UNKNOWN = 'unknown'  # accepted, where there is no reference


@dataclass(frozen=True)
class JudgedLoop:
    """A candidate and what the reference says of it; None where it says nothing.

    Attributes:
        loop: the candidate.
        verdict: its judgement.
        apart_m: true distance between the two keyframes.
        translation_error_m, rotation_error_deg: error of T_match_query.
    """

    loop: LoopConstraint
    verdict: Verdict
    apart_m: float | None = None
    translation_error_m: float | None = None
    rotation_error_deg: float | None = None


@dataclass(frozen=True)
class LoopEvaluation:
    """How well the loops of a drive were found.

    Attributes:
        judged: every candidate, in the order given.
        revisiting_stamps_ns: keyframes that have a partner by the revisit rule.
        missed_stamps_ns: those of them without an accepted, right loop.
    """

    judged: tuple[JudgedLoop, ...]
    revisiting_stamps_ns: NDArray[np.int64]
    missed_stamps_ns: NDArray[np.int64]

    def count(self, verdict: Verdict) -> int:
        """Return how many candidates were judged so."""
        return sum(judged.verdict is verdict for judged in self.judged)

    @property
    def precision(self) -> float | None:
        """Share of the accepted loops that are true; None when none was accepted."""
        true, false = self.count(Verdict.TRUE), self.count(Verdict.FALSE)
        return true / (true + false) if true + false else None

    @property
    def recall(self) -> float | None:
        """Share of the revisiting keyframes with a true loop; None when none revisits."""
        revisiting = len(self.revisiting_stamps_ns)
        return 1.0 - len(self.missed_stamps_ns) / revisiting if revisiting else None


def judge_loops(
    loops: tuple[LoopConstraint, ...],
    keyframe_stamps_ns: NDArray[np.int64],
    scan_stamps_ns: NDArray[np.int64],
    truth: Trajectory,
    settings: LoopJudgementConfig | None = None,
) -> LoopEvaluation:
    """Compare every candidate with the reference.

    Args:
        loops: candidates with their latest verdicts.
        keyframe_stamps_ns: [K] stamps of all keyframes, increasing.
        scan_stamps_ns: [N] stamps of all scans; the revisit rule counts in scans.
        truth: T_world_base.
        settings: limits.
    """
    settings = settings or LoopJudgementConfig()
    judged = tuple(judge_loop(loop, truth, settings) for loop in loops)
    found = {j.loop.query_stamp_ns for j in judged if j.verdict is Verdict.TRUE}
    revisiting = revisiting_keyframes(keyframe_stamps_ns, scan_stamps_ns, truth)
    missed = [stamp for stamp in revisiting if int(stamp) not in found]
    return LoopEvaluation(judged, revisiting, np.array(missed, np.int64))


def judge_loop(
    loop: LoopConstraint, truth: Trajectory, settings: LoopJudgementConfig
) -> JudgedLoop:
    """Judge one candidate by the true relative pose of its keyframes."""
    T_world_match, T_world_query = truth.at(loop.match_stamp_ns), truth.at(loop.query_stamp_ns)
    unknown = Verdict.UNKNOWN if loop.accepted else Verdict.REJECTED
    if T_world_match is None or T_world_query is None:
        return JudgedLoop(loop, unknown)
    T_match_query = se3.inverse(T_world_match) @ T_world_query
    apart = float(np.linalg.norm(T_match_query[:3, 3]))
    if loop.T_match_query is None:
        return JudgedLoop(loop, unknown, apart)
    metres, radians = se3.distance(T_match_query, loop.T_match_query)
    degrees = float(np.degrees(radians))
    right = metres <= settings.max_translation_error and degrees <= settings.max_rotation_error
    verdict = (Verdict.TRUE if right else Verdict.FALSE) if loop.accepted else Verdict.REJECTED
    return JudgedLoop(loop, verdict, apart, metres, degrees)


def revisiting_keyframes(
    keyframe_stamps_ns: NDArray[np.int64], scan_stamps_ns: NDArray[np.int64], truth: Trajectory
) -> NDArray[np.int64]:
    """Return the stamps of the keyframes that see the place of an earlier keyframe again.

    The rule is the thesis's for scans (Table 3.1: within 4 m, the last 50 scans excluded, from scan
    100 on), asked of those scans that are keyframes.
    """
    poses = [truth.at(int(stamp)) for stamp in scan_stamps_ns]
    stamps = scan_stamps_ns[[T is not None for T in poses]]
    positions = np.array([T[:3, 3] for T in poses if T is not None]).reshape(-1, 3)
    is_keyframe = np.isin(stamps, keyframe_stamps_ns)
    has_partner = [
        bool(kept) and bool(is_keyframe[partners].any())
        for kept, partners in zip(is_keyframe, true_loops(positions), strict=True)
    ]
    return stamps[np.array(has_partner, bool)]
