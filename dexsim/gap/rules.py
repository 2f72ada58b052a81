"""The figures that decide: what each means, where its value came from, and which test fails if it is moved."""

from __future__ import annotations

from dataclasses import dataclass, field, fields


def _rule(value: float, means: str, source: str, test: str = "") -> float:
    """A figure: what it means, where its value came from, its test in tests/test_gap_rules.py ("": none holds it)."""
    return field(default=value, metadata={"means": means, "source": source, "test": test})


@dataclass(frozen=True)
class SearchRules:
    """What the search of one joint decides by."""

    least: float = _rule(
        0.12,
        "share of the squared error on conditions left out that an effect must remove",
        "with nothing missing some effect removes a twentieth by accident; set above on planted cases",
        "test_an_effect_must_remove_a_least_share",
    )
    chance: float = _rule(
        0.03,
        "share of the bootstraps in which an effect may be of no use to what was left out",
        "by judgement: a one-sided level between the customary 1 and 5 %",
        "test_an_effect_must_help_in_nearly_all_bootstraps",
    )
    price: float = _rule(
        0.05,
        "chance that the scan's best effect is there by accident, at most; four times as much are still tried",
        "the customary 5 %",
        "test_the_short_list_asks_a_price",
    )
    doubt: float = _rule(
        0.015,
        "relative: what a fitted effect is off by whatever the residuals say",
        "by judgement: the plant itself is trusted to about as much",
        "test_intervals_hold_what_no_residual_shows",
    )
    off: float = _rule(
        0.025,
        "relative: what a refitted belief may be off by whatever the residuals say",
        "by judgement: half of the tolerance within which beliefs are refitted",
        "test_intervals_hold_what_no_residual_shows",
    )
    balance: float = _rule(
        0.03,
        "share of its misfit without any effect that a signal counts as noise at least, beside another",
        "by judgement",
        "",
    )
    restless: float = _rule(
        10.0,
        "x the noise of a resting torque: what changes from sample to sample counts as noise up to as much",
        "by judgement",
        "",
    )
    second: float = _rule(
        0.02,
        "share of what earlier effects removed that a further one must remove",
        "by judgement: less is within what the first law may be off by",
        "test_a_further_effect_must_matter_beside_the_first",
    )
    enough: float = _rule(
        1.08,
        "x the noise: an error within it needs no effect",
        "by judgement: sampling noise of a minute of recordings is below it",
        "test_within_the_noise_nothing_is_looked_for_nearby",
    )
    hint: float = _rule(
        0.03,
        "share of the squared error that an effect must save in the scan to be tried whatever its price",
        "by judgement: a third of what it must remove in the end",
        "",
    )
    rough: float = _rule(
        3.0,
        "x the noise squared: above it every effect that helps is tried, whatever its price",
        "by judgement",
        "test_the_short_list_asks_a_price",
    )
    tie: float = _rule(
        0.02,
        "of the loss: nearer than this, fits without each condition decide",
        "by judgement: twice what a fit ends within",
        "",
    )
    alike: float = _rule(
        0.06,
        "of the loss on what was left out: laws of one effect that come within as much may each be the true one",
        "by judgement: twice the difference that counts for half in a comparison of rivals",
        "test_intervals_hold_the_laws_that_do_as_well",
    )
    clear: float = _rule(
        0.11,
        "share of the squared error that an effect must remove where the error is within the noise without it",
        "set above LEAST on benchmarks.planted: there is less to tell effects by",
        "",
    )
    most: int = _rule(4, "effects on one joint", "by judgement: more of them can imitate anything", "")


SEARCH = SearchRules()


def described() -> list[tuple[str, float, str, str, str]]:
    """(name, value, meaning, source, test) of every rule."""
    return [
        (f.name, getattr(SEARCH, f.name), *(f.metadata[k] for k in ("means", "source", "test"))) for f in fields(SEARCH)
    ]
