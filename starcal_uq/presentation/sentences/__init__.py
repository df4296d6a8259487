"""The words of findings: one entry for each code, which takes the values by their names.

Every entry of a check returns value, bound and sentence, every other a sentence. A code that is
added needs an entry here, and nothing else that knows words.
"""

from starcal_uq.presentation.sentences import (
    advice,
    budgeting,
    draws,
    estimate,
    observed,
    propagation,
    verdict,
)
from starcal_uq.presentation.sentences.table import SENTENCES, wording

__all__ = [
    "SENTENCES",
    "advice",
    "budgeting",
    "draws",
    "estimate",
    "observed",
    "propagation",
    "verdict",
    "wording",
]
