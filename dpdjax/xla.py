"""What XLA is to leave as it is: stages apart, branches that stay so under ``vmap``, members in
turn."""

import jax
import jax.numpy as jnp


def on_cpu() -> bool:
    """Whether programs are made for a CPU, where another way of doing the same may be the fast
    one."""
    return jax.default_backend() == "cpu"


def apart(function, inputs, number):
    """``function(*inputs)`` as a part of the program across whose edges XLA fuses nothing.

    XLA on a CPU computes a value that is cheap to compute again at every one of its uses, however
    many; a barrier does not keep it from it, a branch does. ``number`` is any that XLA cannot know;
    the part is skipped, its outputs zero, where that is not finite. Elsewhere the function is just
    called.
    """
    if not on_cpu():
        return function(*inputs)
    shapes = jax.eval_shape(function, *inputs)
    empty = lambda *_: jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    return jax.lax.cond(jnp.isfinite(number), function, empty, *inputs)


def each_member(function, axes=0):
    """``jax.vmap(function, axes)``; on a CPU the members run one after another, for its caches hold
    one box but not many.

    ``axes`` as for ``jax.vmap``: a prefix of the arguments, of 0 and None.
    """
    if not on_cpu():
        return jax.vmap(function, axes)

    def apply(*arguments):
        batched = [axis == 0 for axis in _axis_of_each_leaf(axes, arguments)]
        leaves, tree = jax.tree.flatten(arguments)

        def one(members):
            members = iter(members)
            return function(
                *jax.tree.unflatten(
                    tree, [next(members) if b else x for b, x in zip(batched, leaves)]
                )
            )

        return jax.lax.map(one, [x for b, x in zip(batched, leaves) if b])

    return apply


def _axis_of_each_leaf(axes, arguments):
    """A prefix of axes written out: 0 or None for every leaf of the arguments."""
    prefix = (axes,) * len(arguments) if isinstance(axes, int) else axes
    found = []
    write_out = lambda axis, part: found.extend([axis] * len(jax.tree.leaves(part)))
    jax.tree.map(write_out, prefix, arguments, is_leaf=lambda axis: axis is None)
    return found


@jax.custom_batching.custom_vmap
def any_in_batch(predicate):
    """``predicate`` itself; under ``vmap`` (nested too) whether any member's holds."""
    return predicate


@any_in_batch.def_vmap
def _(axis_size, in_batched, predicate):
    del axis_size
    # The rule calls the function again, not ``jnp.any`` alone, so that an outer vmap sees it too.
    return any_in_batch(jnp.any(predicate, axis=0) if in_batched[0] else predicate), False


def where_needed(work):
    """``apply(needed, old, *inputs)``: ``work(old, *inputs)`` where ``needed`` holds, else ``old``.

    Under ``vmap`` a plain ``lax.cond`` would do the work for every member at every call. Here
    each member's branch stays its own: on a CPU the members that need the work are visited
    one by one; elsewhere, where many small boxes are cheaper side by side, all do it as soon as
    one must, and the others drop the result. A member never sees its companions either way.

    ``old`` and ``inputs`` are pytrees of arrays that carry no derivative.
    """

    @jax.custom_batching.custom_vmap
    def single(needed, old, inputs):
        # A loop of no or one round: it leaves ``old`` in place, where a branch would copy it.
        once = lambda carry: (jnp.zeros_like(needed), work(carry[1], *inputs))
        return jax.lax.while_loop(lambda carry: carry[0], once, (needed, old))[1]

    @single.def_vmap
    def _(axis_size, in_batched, needed, old, inputs):
        arguments = _all_batched(axis_size, in_batched, (needed, old, inputs))
        return several(*arguments), jax.tree.map(lambda _: True, old)

    @jax.custom_batching.custom_vmap
    def several(needed, old, inputs):
        return (one_by_one if on_cpu() else all_at_once)(work)(needed, old, inputs)

    @several.def_vmap
    def _(axis_size, in_batched, needed, old, inputs):
        arguments = _all_batched(axis_size, in_batched, (needed, old, inputs))
        flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), arguments)
        new = jax.tree.map(lambda x: x.reshape(axis_size, -1, *x.shape[1:]), several(*flat))
        return new, jax.tree.map(lambda _: True, old)

    return lambda needed, old, *inputs: single(needed, old, inputs)


def one_by_one(work):
    """The work for each member of a batch that needs it, in turn: ``f(needed, old, inputs)``."""

    def apply(needed, old, inputs):
        order = jnp.argsort(~needed)
        pick = lambda tree, k: jax.tree.map(
            lambda x: jax.lax.dynamic_index_in_dim(x, k, keepdims=False), tree
        )

        def visit(place, members):
            k = order[place]
            new = work(pick(members, k), *pick(inputs, k))
            return jax.tree.map(
                lambda x, y: jax.lax.dynamic_update_index_in_dim(x, y, k, 0), members, new
            )

        return jax.lax.fori_loop(0, jnp.sum(needed), visit, old)

    return apply


def all_at_once(work):
    """The work for a whole batch if any member needs it, kept where it does:
    ``f(needed, old, inputs)``."""

    def apply(needed, old, inputs):
        def do():
            new = jax.vmap(work)(old, *inputs)
            return jax.tree.map(
                lambda n, o: jnp.where(needed.reshape(-1, *[1] * (n.ndim - 1)), n, o), new, old
            )

        return jax.lax.cond(jnp.any(needed), do, lambda: old)

    return apply


def _all_batched(axis_size, in_batched, arguments):
    """The arguments of a batching rule with the batch in front of every one of them."""
    repeat = lambda x: jnp.broadcast_to(x, (axis_size, *jnp.shape(x)))
    return jax.tree.map(
        lambda batched, x: x if batched else repeat(x), tuple(in_batched), arguments
    )
