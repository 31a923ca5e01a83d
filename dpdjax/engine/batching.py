"""A predicate that stays one for a whole batch, so that ``lax.cond`` stays a branch under vmap."""

import jax
import jax.numpy as jnp


@jax.custom_batching.custom_vmap
def any_in_batch(predicate):
    """``predicate`` itself; under ``vmap`` (nested too) whether any member's holds."""
    return predicate


@any_in_batch.def_vmap
def _(axis_size, in_batched, predicate):
    del axis_size
    batched = in_batched[0]
    # The rule calls the function again, not ``jnp.any`` alone, so that an outer vmap sees it too.
    return (any_in_batch(jnp.any(predicate, axis=0)) if batched else any_in_batch(predicate)), False
