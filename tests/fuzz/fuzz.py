"""Fuzz a parser or reader with atheris: ``python tests/fuzz/fuzz.py pipeline -max_total_time=1800``.

The first word names the target (see targets.py and hostile.py), the rest are libFuzzer's options. A corpus grows in
``build/fuzz/NAME``; a finding is written to ``crash-...`` in the folder this is started in. When it is fixed,
move the file to ``tests/fuzz/cases/NAME/``, where the tests run it for ever.
"""

from __future__ import annotations

import sys
from pathlib import Path

import atheris

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))

# Modules with compiled kernels are left out: numba cannot compile what atheris has instrumented.
_KERNELS = [
    "pdal_stages.classifier.trees",
    "pdal_stages.features",
    "pdal_stages.alsnet",
    "pdal_stages.synthetic",
]
with atheris.instrument_imports(include=["pdal_stages", "json", "zipfile"], exclude=_KERNELS):
    import hostile
    import manifests
    import targets


def main() -> None:
    name, *options = sys.argv[1:]
    corpus = HERE.parents[1] / "build" / "fuzz" / name
    corpus.mkdir(parents=True, exist_ok=True)
    own = next(module for module in (targets, hostile, manifests) if name in module.TARGETS)
    for number, seed in enumerate(own.seeds(name)):
        (corpus / f"seed{number}").write_bytes(seed)
    words = _dictionary(name, corpus.parent)
    target = own.TARGETS[name]

    def one(data: bytes) -> None:
        target(data)

    atheris.Setup(
        [sys.argv[0], f"-dict={words}", "-timeout=60", "-max_len=20000", *options, str(corpus)], one
    )
    atheris.Fuzz()


def _dictionary(name: str, folder: Path) -> Path:
    """Words the formats know, which bytes alone would take long to find."""
    from pdal_stages.stages import registry

    words = {
        "pipeline",
        "type",
        "tag",
        "inputs",
        "filename",
        "//",
        "/*",
        "*/",
        "\\u0000",
        "\\ud800",
        "null",
        "true",
        "1e999",
    }
    if name == "pipeline":
        for kind, stage in registry.stages().items():
            words |= {kind, *(option.name for option in stage.all_options())}
        words |= {
            "kopt",
            "ropt",
            "copt",
            "c1",
            "s2",
            "k50",
            "weinmann2018",
            "extra_dims",
            "minor_version",
            "all",
        }
    else:
        import json

        manifest = json.loads(targets.good_model()["manifest.json"])
        words |= {
            *manifest,
            *manifest["passes"][0],
            *manifest["passes"][0]["features"],
            *manifest["arrays"],
            "PK",
            "<f4",
            "|u1",
            "-1",
            "NaN",
        }
    path = folder / f"{name}.dict"
    escaped = [word.replace("\\", "\\\\").replace('"', '\\"') for word in sorted(words)]
    path.write_text("".join(f'"{word}"\n' for word in escaped))
    return path


if __name__ == "__main__":
    main()
