"""The benchmark on a plant by other hands: seeds from the sources, counts, a skip where the plant is absent."""

from pathlib import Path

from benchmarks import answers, foreign


def answer(verdict: str, *found: tuple[str, float]) -> dict:
    findings = [{"effect": e, "confidence": c, "where": {"joints": ["a"]}, "indistinguishable": []} for e, c in found]
    return {"verdict": verdict, "findings": findings}


def case(id_: str, kind: str, *effects: str, tier: str = "easy") -> dict:
    return {"id": id_, "kind": kind, "tier": tier, "effects": [{"effect": e, "joints": ["a"]} for e in effects]}


def test_counts_by_confidence():
    truths = [
        case("1", "single", "lag"),
        case("2", "single", "backlash"),
        case("3", "null"),
        case("4", "null"),
        case("5", "null"),
    ]
    said = {
        "1": answer("explained", ("lag", 0.9)),
        "2": answer("explained", ("lag", 0.85), ("backlash", 0.6)),
        "3": answer("none", ("lag", 0.4)),
        "4": answer("unknown", ("lag", 0.55)),
        "5": None,
    }
    s = foreign.summary(truths, said)
    assert s["easy_first_name_at_0"] == [1, 2] and s["easy_first_name_at_0.8"] == [1, 2]
    assert s["false_alarms"] == [2, 3]  # a name of 0.55, and no answer
    assert s["confident_and_wrong"] == [1, 5] and s["answered"] == 4


def test_the_seed_follows_the_sources(tmp_path):
    (tmp_path / "a.py").write_text("x = 1\n")
    first = answers.seed_of_sources(tmp_path)
    (tmp_path / "notes.txt").write_text("no source")
    assert answers.seed_of_sources(tmp_path) == first and 10_000 <= first < 100_000
    (tmp_path / "a.py").write_text("x = 2\n")
    assert answers.seed_of_sources(tmp_path) != first


def test_it_skips_where_the_plant_is_absent(tmp_path, capsys):
    assert foreign.main([f"plant={tmp_path}", f"out={tmp_path / 'out'}"]) is None
    assert "skipped" in capsys.readouterr().out and not Path(tmp_path / "out").exists()
