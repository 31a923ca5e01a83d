"""Sums of many small steps: what rounding leaves out of a sum is kept beside it, and added with the
next step.

A plain sum stops growing where its steps fall below half a unit in its last place: in single
precision a bead at 10 that moves by 1e-7 a step stays where it is.
"""

import jax


def plus(total, rest, step):
    """The sum ``total + step``, and what it leaves out, from those so far (Kahan 1965); arrays of
    one shape."""
    step = step + rest
    new = total + step
    # Without a derivative: it is that of rounding, and exactly zero.
    return new, jax.lax.stop_gradient(step - (new - total))
