"""Class map: which labels become which class; both classes of a binary task."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ..accuracy.labels import MAX_LABEL, code_of
from ..base.asprs import NAMES, UNINFORMATIVE, class_name
from ..base.errors import OptionError, suggest

#: The largest code a point can carry.
MAX_CODE = 255
#: Code of all classes but the target of a binary task: ASPRS "Unclassified".
BACKGROUND = 1

#: ASPRS name, in small letters -> code.
_CODES = {name.lower(): code for code, name in NAMES.items()}
_CURE = (
    "Write classes as a list of codes, [2, 5, 6], or as labels and what they become: "
    '{"2": "Ground", "3,4,5": "5 Vegetation", "6": 6}. Other labels are left out'
)


@dataclass(frozen=True)
class ClassMap:
    """Classes a model tells apart, and the labels each is made of."""

    codes: tuple[int, ...]  #: ASPRS codes written to points, ascending
    names: tuple[str, ...]
    labels: tuple[tuple[int, ...], ...]  #: labels in the training clouds that become the class

    @classmethod
    def parse(
        cls,
        spec: object,
        labels_found: Iterable[int] = (),
        left_out: Collection[int] = UNINFORMATIVE,
    ) -> ClassMap:
        """Read the option `classes`.

        Parameters
        ----------
        spec : None, str, list of codes or mapping
            None: every label as it is, except those `left_out`. A list: those labels as they
            are. A mapping: labels (``"3,4,5"``, ``"3-5"``) to a code, an ASPRS name, or a code with
            a name (``"5 Trees"``). Labels not mentioned are dropped. Text is a comma-separated
            list.
        labels_found : iterable of int
            Labels in the training clouds, for None.
        left_out : collection of int
            Labels that are no classes of themselves.
        """
        if spec is None:
            spec = [label for label in sorted(set(map(int, labels_found))) if label not in left_out]
        elif isinstance(spec, str):
            spec = _labels(spec)
        if isinstance(spec, Mapping):
            pairs = [(_labels(key), value) for key, value in spec.items()]
        elif isinstance(spec, Iterable):
            pairs = [((_code(item, "label"),), _code(item, "code")) for item in spec]
        else:
            raise OptionError("'classes' must be a list or a mapping", found=repr(spec), cure=_CURE)
        names: dict[int, str | None] = {}
        members: dict[int, list[int]] = {}
        for labels, value in pairs:
            code, name = _target(value)
            names[code] = names.get(code) or name
            members.setdefault(code, []).extend(labels)
        every = [label for labels, _ in pairs for label in labels]
        if len(every) > len(set(every)):
            twice = next(label for label in sorted(every) if every.count(label) > 1)
            raise OptionError("'classes' names a label twice", found=twice, cure=_CURE)
        codes = tuple(sorted(members))
        named = tuple(names[code] or class_name(code) for code in codes)
        return cls(codes, named, tuple(tuple(sorted(members[code])) for code in codes))

    def binary(self, target: int) -> ClassMap:
        """Return one class against all the others, which become :data:`BACKGROUND`."""
        others = [code for code in self.codes if code != target]
        if target not in self.codes or target == BACKGROUND or not others:
            raise OptionError(
                f"'target' must be one of several classes, and not {BACKGROUND}, which the others "
                "become",
                found=target,
                cure=f"Choose one of {list(self.codes)}",
            )
        i = self.codes.index(target)
        rest = tuple(sorted({label for part in self.labels for label in part} - {*self.labels[i]}))
        both = sorted([(target, self.names[i], self.labels[i]), (BACKGROUND, "Background", rest)])
        return ClassMap(*zip(*both, strict=True))

    def index(self, labels: npt.NDArray) -> npt.NDArray[np.int16]:
        """Return (n,) int16: the position of each label's class, -1 where it is dropped."""
        labels = np.asarray(labels)
        highest = max((label for part in self.labels for label in part), default=0)
        table = np.full(highest + 2, -1, np.int16)
        for position, part in enumerate(self.labels):
            table[list(part)] = position
        return table[np.minimum(labels, highest + 1)]


def _labels(text: object) -> tuple[int, ...]:
    """Return the labels that ``"3,4,5"``, ``"3-5"`` or 3 stands for."""
    if not isinstance(text, str):
        return (_code(text, "label"),)
    labels: list[int] = []
    for part in text.split(","):
        span = re.fullmatch(r"\s*(\d{1,5})(?:\s*-\s*(\d{1,5}))?\s*", part)
        if span is None:
            raise OptionError(
                "a key of 'classes' is not a list of labels", found=repr(text), cure=_CURE
            )
        first, last = int(span[1]), int(span[2] or span[1])
        if last < first or last > MAX_LABEL:
            raise OptionError("'classes' has a bad label range", found=part.strip(), cure=_CURE)
        labels.extend(range(first, last + 1))
    return tuple(dict.fromkeys(labels))


def _code(value: object, what: str) -> int:
    try:
        return code_of(f"a class {what}", value, MAX_CODE if what == "code" else MAX_LABEL)
    except OptionError as error:
        error.cure = _CURE
        raise


def _target(value: object) -> tuple[int, str | None]:
    """Return the code and name that a mapping's value stands for."""
    if not isinstance(value, str):
        return _code(value, "code"), None
    word = " ".join(value.split())
    if match := re.fullmatch(r"(\d{1,5})\s*[:=]?\s*(.*)", word):
        return _code(match[1], "code"), match[2] or None
    if word.lower() not in _CODES:
        raise OptionError(
            f"'{word}' is not an ASPRS class",
            cure=suggest(word.lower(), _CODES) + f"Say its code too: '5 {word}'",
        )
    return _CODES[word.lower()], word
