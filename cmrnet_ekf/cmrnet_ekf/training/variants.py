"""Say what each variant of the thesis is: network, training and loss."""

from dataclasses import dataclass, replace

from cmrnet_ekf.networks.config import COMPACT, COMPACT_FINE, FULL, CmrnetConfig
from cmrnet_ekf.networks.losses import LossConfig
from cmrnet_ekf.training.trainer import TrainingConfig

# A small network learns faster, and two CPU cores do not wait for 190,000 batches.
_QUICK = TrainingConfig(
    steps=12000, batch=8, learning_rate=1e-3, schedule='cosine', half=True, roll=0.0
)
NETWORKS: dict[str, tuple[CmrnetConfig, TrainingConfig]] = {
    'full': (FULL, TrainingConfig()),
    'compact': (COMPACT, _QUICK),
    'compact_fine': (COMPACT_FINE, _QUICK),
}
# Nor for a correlation that finds out by itself what poses tell. Angles are small beside metres:
# they weigh more, and evidence is measured in units of about the errors that are left.
_COMPACT_MATCHING, _COMPACT_ROTATION = 1.0, 5.0
_COMPACT_UNIT_ROTATION, _COMPACT_UNIT_TRANSLATION = 0.035, 0.5
VARIANTS = {
    'plain': 'CMRNet; with another --seed, a member of a deep ensemble',
    'mcd': 'dropout of 0.3 on the FC layers, for Monte Carlo sampling',
    'der': 'deep evidential regression as in the thesis (L^D, L^R, L^G, two steps)',
    'nll': 'deep evidential regression as Amini et al. have it: the negative logarithm, no L^G',
    'covariance': 'a Gaussian with a full 6 x 6 covariance',
}


@dataclass(frozen=True)
class Variant:
    """A network with how it is trained."""

    network: CmrnetConfig
    training: TrainingConfig
    loss: LossConfig


def variant(name: str, network: str) -> Variant:
    """Return one of VARIANTS of one of NETWORKS."""
    shape, training = NETWORKS[network]
    loss = LossConfig()
    if name == 'mcd':
        shape = replace(shape, dropout=0.3)
    elif name in ('der', 'nll'):
        shape = replace(shape, head='evidential')
        if name == 'nll':
            loss = LossConfig(
                density='log', geometric=False, evidence_first=1.0, evidence_second=1.0
            )
    elif name == 'covariance':
        shape = replace(shape, head='covariance')
    if network != 'full':
        loss = replace(loss, matching_weight=_COMPACT_MATCHING)
        if loss.geometric:
            loss = replace(loss, scale_rotation=_COMPACT_ROTATION)
        if name == 'der':
            loss = replace(
                loss,
                unit_rotation=_COMPACT_UNIT_ROTATION,
                unit_translation=_COMPACT_UNIT_TRANSLATION,
            )
    return Variant(shape, training, loss)
