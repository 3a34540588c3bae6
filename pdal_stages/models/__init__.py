"""Models that come with the package: files beside this module, each with a card in the docs."""

from __future__ import annotations

from pathlib import Path

#: What is used where no model is named.
STANDARD = "standard"


def shipped() -> dict[str, Path]:
    """Name -> file of every shipped model, in alphabetical order."""
    return {path.stem: path for path in sorted(Path(__file__).parent.glob("*.model"))}


def find(name: str) -> str:
    """The file of a model: of a shipped one by its name; a file in the current folder that is called so is ``./name``.

    So what is run does not depend on what lies in the folder, which others may write to.
    """
    path = shipped().get(name)
    return name if path is None else str(path)
