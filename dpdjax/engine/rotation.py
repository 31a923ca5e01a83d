"""Rotation of spheres, beside their translation."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Rotation:
    """How the m beads that rotate, which lie together, are turned and turning; in the frame of the
    lab.

    Attributes:
        velocity: angular velocity (m, 3) [1/time].
        torque: of the last step, (m, 3) [energy].
        orientation: unit quaternions (m, 4), the scalar first; turns the body's axes into the
            lab's.
        orientation_rest: what rounding has left out of them, (m, 4).
        begin: slot of the first of them (static).
    """

    velocity: Any
    torque: Any
    orientation: Any
    orientation_rest: Any
    begin: int = dataclasses.field(metadata={"static": True})

    @classmethod
    def of(cls, velocity, begin: int) -> "Rotation":
        """Beads with these angular velocities (m, 3) and the axes of the lab."""
        orientation = jnp.zeros((len(velocity), 4), velocity.dtype).at[:, 0].set(1.0)
        return cls(
            velocity, jnp.zeros_like(velocity), orientation, jnp.zeros_like(orientation), begin
        )

    @property
    def m(self) -> int:
        """Number of beads that rotate."""
        return self.velocity.shape[-2]

    @property
    def slots(self) -> slice:
        """Where they are among all beads."""
        return slice(self.begin, self.begin + self.m)

    @property
    def axis(self):
        """The body's z-axis as the lab sees it (..., m, 3), a unit vector that turns with each
        bead.
        """
        return axis_of(self.orientation)


def axis_of(orientation):
    """The body's z-axis (..., 3) of quaternions (..., 4)."""
    w, x, y, z = (orientation[..., k] for k in range(4))
    return jnp.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=-1)


def rotation_step(orientation, angle):
    """What a small turn by the vectors ``angle`` (m, 3) [radian] adds to unit quaternions (m, 4);
    wrong by angle^3/12."""
    w, v, half = orientation[:, :1], orientation[:, 1:], 0.5 * angle
    step = jnp.concatenate(
        [-jnp.sum(half * v, axis=1, keepdims=True), w * half + jnp.cross(half, v)], axis=1
    )
    longer = orientation + step
    return step + longer * (1.0 / jnp.linalg.norm(longer, axis=1, keepdims=True) - 1.0)
