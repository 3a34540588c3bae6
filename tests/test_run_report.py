"""One type for what stages, predictions and engines report: filled and merged by name."""

from pdal_stages.base.report import Report


def test_merging_keeps_its_own_figures_and_joins_the_rest():
    own = Report({"points": 5, "few": {"c1": 2}}, notes=["a"], beyond_halo={"k10": 1})
    own.merge(
        Report(
            {"points": 9, "density": 2.5, "few": {"c1": 7, "c2": 3}},
            ["a", "b"],
            ["w"],
            {"k10": 4, "k50": 2},
        )
    )
    assert own.figures == {"points": 5, "few": {"c1": 2, "c2": 3}, "density": 2.5}
    assert own.beyond_halo == {"k10": 1, "k50": 2}
    assert own.messages == ["w", "a", "b"]


def test_merging_shares_nothing_with_the_other():
    own, other = Report(), Report({"few": {"c1": 1}}, ["a"])
    own.merge(other)
    own.figures["few"]["c1"] = 9
    own.notes.append("b")
    assert other == Report({"few": {"c1": 1}}, ["a"])


def test_metadata_has_messages_only_where_there_are_any():
    assert Report({"points": 1}).to_dict() == {"points": 1}
    full = Report({"points": 1}, ["a"], ["w", "x"], {"k10": 3})
    assert full.to_dict() == {
        "points": 1,
        "beyond_halo": {"k10": 3},
        "warning": "w. x",
        "note": "a",
    }
