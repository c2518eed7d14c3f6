"""Hold what the heads say of the pose.

Components, everywhere: x y z (metres) and roll pitch yaw (radians) of T_guess_camera, with
R = Rz(yaw) Ry(pitch) Rx(roll).
"""

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class QuaternionPose:
    """CMRNet's own output: translation [B x 3] and unit quaternion x y z w [B x 4]."""

    translation: Tensor
    quaternion: Tensor


@dataclass(frozen=True)
class Evidence:
    """A normal-inverse-gamma distribution of each component: four times [B x 6].

    nu > 0, alpha > 1, beta > 0. The component itself is Student-t distributed with 2 alpha degrees
    of freedom around gamma.
    """

    gamma: Tensor
    nu: Tensor
    alpha: Tensor
    beta: Tensor

    @property
    def amount(self) -> Tensor:
        """Phi of equation 28: the amount of evidence."""
        return 2.0 * self.nu + self.alpha

    @property
    def epistemic_variance(self) -> Tensor:
        """Var[mu] of equation 26."""
        return self.beta / (self.nu * (self.alpha - 1.0))

    @property
    def aleatoric_variance(self) -> Tensor:
        """Return E[sigma^2] of Amini et al."""
        return self.beta / (self.alpha - 1.0)

    @property
    def squared_scale(self) -> Tensor:
        """Squared scale of the Student-t distribution (section 5.2.2)."""
        return self.beta * (1.0 + self.nu) / (self.nu * self.alpha)

    @property
    def degrees_of_freedom(self) -> Tensor:
        """Return those of the Student-t distribution."""
        return 2.0 * self.alpha


@dataclass(frozen=True)
class GaussianPose:
    """A Gaussian: mean [B x 6], and lower triangle L [B x 6 x 6] with L L^T the information."""

    mean: Tensor
    information_root: Tensor


Output = QuaternionPose | Evidence | GaussianPose
