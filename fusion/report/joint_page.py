"""Two campaigns of one machine on a page of their own: which session is which, what both show, and what only one shows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from fusion.attribution.two_sessions import ChannelAgreement, SessionComparison, SourceAgreement
from fusion.products.results import Results
from fusion.report.conclusions.answers import headline
from fusion.report.page import render_page
from fusion.report.tables import Table, Words, table
from fusion.report.wording import CHANNELS, alike, duration, join, measured, moment, number, p_cell, place

_LETTERS = ("A", "B")


@dataclass(frozen=True)
class SourceWords:
    """A source in words.

    Attributes
    ----------
    name : str
        Name of its place, the same in report, terminal and file.
    where : str
        Place on the plan and part of the drift.
    shown : tuple of str
        What the first and the second session show there.
    verdict : str
        Whether it is a cause, and if not, why.
    """

    name: str
    where: str
    shown: tuple[str, ...]
    verdict: str


def session_names(results: Sequence[Results]) -> list[str]:
    """Return the names of two sessions: a letter and the title of the campaign.

    Parameters
    ----------
    results : sequence of Results
        Of both campaigns.
    """
    return [f"{letter} ({one.campaign})" for letter, one in zip(_LETTERS, results, strict=True)]


def describe_sources(comparison: SessionComparison, sessions: Sequence[str]) -> list[SourceWords]:
    """Return every source that either session shows, in words; places are numbered.

    Parameters
    ----------
    comparison : SessionComparison
        Of both sessions.
    sessions : sequence of str
        Their names, as from `session_names`.
    """
    names = {_key(source): f"place {k}" for k, source in enumerate(comparison.sources, start=1)}
    return [
        SourceWords(
            names[_key(source)],
            f"{place(source.x_mm, source.y_mm)}, {CHANNELS.get(source.channel, source.channel)}",
            _shown(source, comparison.least_p),
            _verdict(source, sessions, names),
        )
        for source in comparison.sources
    ]


def _key(source: SourceAgreement) -> tuple[str, float, float]:
    return source.channel, source.x_mm, source.y_mm


def _shown(source: SourceAgreement, least_p: tuple[float, float]) -> tuple[str, ...]:
    """What the first and the second session show at a place."""
    sizes, us = source.sensitivity_um_per_K, source.sensitivity_u_um_per_K
    return tuple(
        f"p {p_cell(p, least)}, {measured(value, u, 'µm/K')}, {f'lag {duration(lag)}' if lag else 'no lag'}"
        for p, least, value, u, lag in zip(source.p_value, least_p, sizes, us, source.lag_s, strict=True)
    )


def _verdict(source: SourceAgreement, sessions: Sequence[str], names: dict[tuple[str, float, float], str]) -> str:
    """Whether a source is a cause, and if not, why: nothing there, another size, or a neighbouring place that both show."""
    if source.cause:
        return "a cause: both sessions agree in place, sign and size"
    if source.agrees:
        return "both sessions agree here, but it is no source of its own: it may only warm with a neighbouring one"
    (shown,) = source.shown_by
    other = sessions[1 - shown]
    texts = [f"shown by {sessions[shown]} alone"]
    if max(source.p_value) <= 0.05:
        a, b = alike(source.sensitivity_um_per_K)
        texts.append(f"{other} shows something there too, but not the same: {a} and {b} µm/K")
    elif source.power is not None:
        texts.append(f"{other} would have shown the same size with a chance of {100 * source.power:.0f} %")
    if source.agreed_near_mm is not None:
        x_mm, y_mm, distance = source.agreed_near_mm
        near = names[(source.channel, x_mm, y_mm)]
        texts.append(
            f"{distance:.0f} mm beside it both agree ({near}), so that one heat source may be behind both places"
        )
    return "; ".join(texts)


def conclude_sessions(comparison: SessionComparison, told: Sequence[SourceWords], sessions: Sequence[str]) -> list[str]:
    """Return what two sessions say together: one sentence on what both show, one for each on what it shows alone.

    Parameters
    ----------
    comparison : SessionComparison
        Of both sessions.
    told : sequence of SourceWords
        Its sources, as from `describe_sources`.
    sessions : sequence of str
        Names of the sessions.
    """
    pairs = list(zip(comparison.sources, told, strict=True))
    causes = [f"{words.name} ({words.where})" for source, words in pairs if source.cause]
    agreed = [f"{words.name} ({words.where})" for source, words in pairs if source.agrees and not source.cause]
    sentences = [
        f"Both sessions show the same cause{'s' if len(causes) > 1 else ''}: {join(causes)}."
        if causes
        else "The two sessions show no cause together."
    ]
    if agreed:
        sentences.append(f"Both agree in {join(agreed)}, without showing a source of its own there.")
    for k, session in enumerate(sessions):
        alone = [words.name for source, words in pairs if source.shown_by == (k,)]
        if alone:
            sentences.append(f"{session} alone shows {join(alone)}.")
    if not comparison.sources:
        sentences = [
            "Neither session shows a source; what either could have shown stands in its own report (detection limits)."
        ]
    if all(channel.verdict == "not separable" for channel in comparison.channels):
        sentences.append(
            "Both sessions are one warm-up each, in which no places can be told apart: switch the heat sources at random."
        )
    return sentences


def sources_table(told: Sequence[SourceWords], sessions: Sequence[str]) -> Table | None:
    """Return the sources that either of two sessions shows; None where neither shows one.

    Parameters
    ----------
    told : sequence of SourceWords
        As from `describe_sources`.
    sessions : sequence of str
        Names of the sessions.
    """
    columns = [Words(title) for title in ("Place", "Where, and part of the drift", *sessions, "Verdict")]
    rows = [[one.name, one.where, *one.shown, one.verdict] for one in told]
    return table(columns, rows, stacked=True) if rows else None


def channel_sentence(channel: ChannelAgreement) -> str:
    """Return the agreement on one part of the drift as a sentence.

    Parameters
    ----------
    channel : ChannelAgreement
        One of `SessionComparison.channels`.
    """
    first, second = alike(channel.sensitivity_um_per_K)
    where = place(channel.x_mm, channel.y_mm)
    return f"{channel.verdict}: {channel.reason}; {where}, larger p of both {p_cell(channel.p_value)}, {first} and {second} µm/K"


def render_joint(results: Sequence[Results], folders: Sequence[str], comparison: SessionComparison) -> str:
    """Return the page of two campaigns as HTML text.

    Parameters
    ----------
    results : sequence of Results
        Of both campaigns.
    folders : sequence of str
        Their results folders, seen from the page.
    comparison : SessionComparison
        Of both sessions.

    Returns
    -------
    str
        One HTML page that needs no other file and no network.
    """
    sessions = session_names(results)
    told = describe_sources(comparison, sessions)
    return render_page(
        "joint.html.j2",
        {},
        title=f"{results[0].campaign} and {results[1].campaign}",
        sentences=conclude_sessions(comparison, told, sessions),
        sessions=_sessions_table(results, sessions),
        reports=[(name, f"{folder}/report.html") for name, folder in zip(sessions, folders, strict=True)],
        sources=sources_table(told, sessions),
        channels=[(CHANNELS.get(one.channel, one.channel), channel_sentence(one)) for one in comparison.channels],
        summary={"premises": {}},
    )


def _sessions_table(results: Sequence[Results], sessions: Sequence[str]) -> Table:
    """Return which session is which: when it was, what it found by itself, and its prediction error."""
    rows = []
    for name, one in zip(sessions, results, strict=True):
        when = f"{moment(one.time.first, one.time.zone)} to {moment(one.time.last, one.time.zone)}" if one.time else "–"
        error = number(one.loop.rmse_final_um, 2) if one.loop else "–"
        rows.append([name, when, headline(one), error])
    return table([Words("Session"), Words("Time"), Words("By itself"), "Prediction error / µm"], rows, stacked=True)
