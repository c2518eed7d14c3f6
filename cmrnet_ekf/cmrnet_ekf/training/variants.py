"""Say what each variant of the thesis is: network, training and loss."""

from dataclasses import dataclass, replace

from cmrnet_ekf.networks.config import COMPACT, FULL, CmrnetConfig
from cmrnet_ekf.networks.losses import LossConfig
from cmrnet_ekf.training.trainer import TrainingConfig

NETWORKS: dict[str, tuple[CmrnetConfig, TrainingConfig]] = {
    'full': (FULL, TrainingConfig()),
    # A small network learns faster, and two CPU cores do not wait for 190,000 batches.
    'compact': (
        COMPACT,
        TrainingConfig(steps=8000, batch=8, learning_rate=5e-4, schedule='cosine', half=True),
    ),
}
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
    return Variant(shape, training, loss)
