"""What speaks against the class of the worst patches of a review: inputs of the model there."""

from __future__ import annotations

from collections.abc import Sequence

from ..base.asprs import HIGH_VEGETATION, LOW_VEGETATION, MEDIUM_VEGETATION
from ..base.errors import StageError
from ..base.messages import print_messages
from ..pipeline.classify_request import ClassifyRequest
from .explain import explain_points
from .explanation import AskedPlace, Explanation
from .explanation_text import show_value
from .input_words import words_for
from .trace_points import SURROUNDINGS

#: Meters around a patch within which points are read: the ground filter's widest roofs are wider.
_REACH_M = 200.0
#: Inputs that are named.
_COUNT = 2


def inputs_against(files: Sequence[str], places: Sequence[AskedPlace], model: str) -> list[str]:
    """Return for each place the inputs that speak most against the class there, in words.

    Where nothing can be told, the text is empty, and a message says why.
    """
    try:
        request = ClassifyRequest(model, noise=False, towers=False)
        return [_against(each) for each in explain_points(files, places, request, _REACH_M)]
    except StageError as error:
        print_messages(f"what speaks against the classes is not known: {error}")
        return [""] * len(places)


def _against(told: Explanation) -> str:
    """Return the inputs of the first pass that lower its class most, beside its strongest rival."""
    verdict, code = told.verdict, told.in_file
    if verdict is None or not verdict.passes:
        return ""
    if code in (LOW_VEGETATION, MEDIUM_VEGETATION) and code not in verdict.classes:
        code = HIGH_VEGETATION
    others = [other for other in verdict.classes if other != code]
    rival = max(others, key=lambda other: verdict.passes[0].probabilities.get(other, 0.0))
    weights = {
        each.added.get(code, 0.0) - each.added.get(rival, 0.0): each
        for each in verdict.passes[0].inputs
        if each.name != SURROUNDINGS
    }
    worst = [weights[weight] for weight in sorted(weights) if weight < 0][:_COUNT]
    return "; ".join(f"{words_for(each.name)[0]}: {show_value(each)}" for each in worst)
