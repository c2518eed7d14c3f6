"""Judge a network on places that it was not trained on."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from lcd_common import se3
from lcd_loop_closure.evaluation.pair_protocol import PairScores, protocol_2
from lcd_loop_closure.feature_registration import FeatureRegistration
from lcd_loop_closure.lcdnet.network import Lcdnet
from lcd_loop_closure.lcdnet.places import PlaceShard
from lcd_loop_closure.lcdnet.voxels import Clouds

# A registration counts when it is off by no more (thesis section 3.3.4).
SUCCESS_M, SUCCESS_RAD = 2.0, float(np.radians(5.0))


@dataclass(frozen=True)
class Validation:
    """How well places are told apart and sweeps are registered.

    Attributes:
        places: how many.
        recall_1: share of places whose most similar other sweep is their own second one.
        average_precision: of all pairs of a first and a second sweep by descriptor distance.
        loops_success, far_success: share of the pairs registered by features within 2 m and 5
            degrees: loops (up to 4 m), and pairs 4 to 15 m apart.
        fast_success: the same of loops by transport alone.
        loops_te_m: mean translation error of the loops that count as registered; None without any.
        pose_te_m, pose_re_rad: mean errors of the pose head over all loops, right or not.
    """

    places: int
    recall_1: float
    average_precision: float
    loops_success: float
    far_success: float
    fast_success: float
    loops_te_m: float | None
    pose_te_m: float
    pose_re_rad: float

    @property
    def score(self) -> float:
        """One number to choose a checkpoint by."""
        return self.average_precision + 0.5 * (self.loops_success + self.far_success)


@torch.no_grad()
def validate(
    network: Lcdnet, shards: Sequence[PlaceShard], places: int, *, seed: int = 0
) -> Validation:
    """Judge a network on `places` places of each shard, each sweep turned at random."""
    training, device = network.training, next(network.parameters()).device
    network.eval()
    rng = np.random.default_rng([seed, 83])
    registration = FeatureRegistration()
    first, second, successes = [], [], []
    for shard in shards:
        for number in range(min(places, len(shard))):
            place = shard.place(number)
            turned = [se3.rotation_z(float(rng.uniform(-np.pi, np.pi))) for _ in place.sweeps]
            xyz = [
                torch.from_numpy((sweep.xyz @ T[:3, :3].T).astype(np.float32)).to(device)
                for sweep, T in zip(place.sweeps, turned, strict=True)
            ]
            light = [torch.from_numpy(sweep.intensity).to(device) for sweep in place.sweeps]
            features = network(Clouds.of(xyz, light))
            first.append(features.descriptors[0].cpu().numpy())
            second.append(features.descriptors[1].cpu().numpy())
            poses = [
                sweep.T_world_base @ se3.inverse(T)
                for sweep, T in zip(place.sweeps, turned, strict=True)
            ]
            fast = network.relative_pose(
                features, torch.tensor([0], device=device), torch.tensor([1], device=device)
            )[0]
            keypoints, values = features.keypoints.cpu().numpy(), features.features.cpu().numpy()
            row = [_errors(fast.cpu().numpy(), se3.inverse(poses[1]) @ poses[0])]
            for other in (1, 2):
                found = registration.search(
                    keypoints[0], values[0], keypoints[other], values[other]
                )
                true = se3.inverse(poses[other]) @ poses[0]
                row.append(_errors(found[0].T_match_query if found else None, true))
            successes.append(row)
    network.train(training)
    distance = np.linalg.norm(np.array(first)[:, None] - np.array(second)[None], axis=2)
    errors = np.array(successes)  # [places x 3 x 2]
    right = (errors[..., 0] <= SUCCESS_M) & (errors[..., 1] <= SUCCESS_RAD)
    te = errors[right[:, 1], 1, 0]
    return Validation(
        len(distance),
        float(np.mean(distance.argmin(1) == np.arange(len(distance)))),
        protocol_2(_scores(distance)).average_precision,
        float(right[:, 1].mean()),
        float(right[:, 2].mean()),
        float(right[:, 0].mean()),
        float(te.mean()) if len(te) else None,
        *errors[:, 0].mean(0).tolist(),
    )


def _errors(T: NDArray[np.floating] | None, T_true: se3.Array) -> tuple[float, float]:
    if T is None:
        return np.inf, np.inf
    return se3.distance(np.asarray(T, np.float64), T_true)


def _scores(distance: NDArray[np.floating]) -> PairScores:
    """Return [n x n] distances whose diagonal alone shows one place."""
    right = np.eye(len(distance), dtype=bool)
    values = distance.astype(np.float32)
    return PairScores(values[right], np.zeros(len(distance), bool), (values[~right],))
