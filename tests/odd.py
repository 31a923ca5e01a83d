"""How odd inputs are drawn, and how much may be said of them."""

import hypothesis

LONGEST = 900
"""Characters of a message, at most: a page is none."""
ALIKE = hypothesis.settings(
    deadline=None,
    derandomize=True,
    database=None,
    suppress_health_check=list(hypothesis.HealthCheck),
)
"""The same examples every time, however long they take."""
