"""The former place of protocol 1."""

from lcd_loop_closure.evaluation.detection_protocols import (
    Candidates,
    DistancesTo,
    PrecisionRecall,
    candidates,
    protocol_1,
)

__all__ = ['Candidates', 'DistancesTo', 'PrecisionRecall', 'candidates', 'protocol_1']
