"""What measures return shows itself shortly: estimates as they print, arrays by their shapes."""

import dataclasses

import numpy as np

from dpdjax.measure.statistics import Estimate


class Result:
    """A base of dataclasses, which say ``repr=False``."""

    def __repr__(self):
        fields = [field.name for field in dataclasses.fields(self)]
        said = ", ".join(f"{name}={_brief(getattr(self, name))}" for name in fields)
        return f"{type(self).__name__}({said})"


def _brief(value) -> str:
    if isinstance(value, Estimate):
        return str(value)
    if isinstance(value, float):
        return f"{value:.4g}"
    return f"array{np.shape(value)}" if hasattr(value, "shape") and np.ndim(value) else repr(value)
