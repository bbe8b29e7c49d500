"""The page of a report: the sweep's inputs, its statistics and figures, its worst cases."""

import html as markup
import os
import shlex
from pathlib import Path
from typing import Any

from jaxguide.report import figures
from jaxguide.report.embed import drawn
from jaxguide.sweeping import store as stores
from jaxguide.types import RESULTS

STYLE = (Path(__file__).parent / "page.css").read_text()
_WORST = 10  # cases in the table of the worst: half of those that a sweep keeps


def write(store: Path, out: Path | None = None) -> Path:
    """Writes the report of the sweep stored at `store` to `out` (default: beside it, .html).

    **Returns:** the path of the file.

    **Raises:** `ValueError` if there is no sweep, or one that was not flown to its end.
    """
    store = Path(store)
    out = store.with_suffix(".html") if out is None else Path(out)
    text = html(store)
    out.parent.mkdir(parents=True, exist_ok=True)
    beside = out.with_name(f".{out.name}.partial")
    beside.write_text(text, encoding="utf-8")
    os.replace(beside, out)
    return out


def html(store: Path) -> str:
    """The report as one HTML text: figures inside, no script, nothing to be fetched.

    **Raises:** `ValueError` as `write`.
    """
    described = stores.attributes_of(store)
    if "summary" not in described:
        raise ValueError(
            f"{store} holds a sweep that was not flown to its end; go on with the same command "
            "and --resume."
        )
    data = stores.open_store(store)
    manifest, attrs = described["sweep"], data.attrs
    name = manifest.get("label") or attrs["about"]["plant"]["class"]
    title = f"Sweep of {name}, {attrs['flown']:,} flights"
    sections = [
        _inputs(manifest, attrs),
        _failures(attrs),
        _percentiles(attrs),
        *_drawn_sections(store, data),
        _worst(attrs, manifest, store),
    ]
    body = "\n".join(section for section in sections if section)
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{_text(title)}</title>\n<style>\n{STYLE}</style>\n</head>\n<body>\n<main>\n"
        f"<h1>{_text(title)}</h1>\n{_headline(attrs)}\n{body}\n</main>\n</body>\n</html>\n"
    )


def _drawn_sections(store: Path, data: Any) -> list[str]:
    """The sections that hold a figure or, without one, a note; "" for one with neither."""
    attrs, cases = data.attrs, figures.shown_cases(data)
    entries = list(next(iter(attrs["importance"].values()), {}))
    return [
        _section(
            "How the ends are spread",
            drawn(figures.histograms, attrs, stores.total_histograms(store), title="histograms"),
            "All successful flights, less the undispersed one; lines at the 1st, 50th and 99th "
            "percentiles.",
        ),
        _section(
            "Dispersion of the final state",
            drawn(figures.corner, data, cases, title="dispersion of the final state"),
            "Three-sigma ellipses: sampled, about the mean of the flights; linear, about the "
            "undispersed flight. Where they differ, the loop is not linear. " + _dots(cases, attrs),
        ),
        _section(
            "What matters",
            drawn(figures.variance_shares, attrs, title="sensitivities"),
            "Share of each outcome's variance that a drawn number explains by itself: bars from "
            "the flights (first-order Sobol index, 95 % bounds), diamonds from the derivatives of "
            "the undispersed flight. What is missing to 100 % is interaction, or noise.",
        ),
        _section(
            "Draws against miss",
            drawn(figures.draws_against_miss, data, cases, entries, title="draws against miss"),
            _dots(cases, attrs),
        ),
        _section(
            "Envelopes",
            drawn(figures.envelopes, data, title="envelopes"),
            _kept(data),
        ),
    ]


def _text(value: Any) -> str:
    return markup.escape(str(value))


def _sampling(interval: Any) -> str:
    if isinstance(interval, list):  # of every sample by itself
        used = [length for length in interval if length > 0]
        return f"{len(used)} times, {_number(min(used))} to {_number(max(used))} apart"
    return f"every {_number(interval)}"


def _number(value: Any, digits: int = 6) -> str:
    if value is None:
        return "none"
    return f"{value:,}" if isinstance(value, int) else f"{value:.{digits}g}"


def _table(head: tuple[str, ...], rows: list[tuple], left: int = 1) -> str:
    """`left` columns of words, then numbers."""
    kind = lambda i: ' class="word"' if i < left else ""
    cells = lambda row, tag: "".join(f"<{tag}{kind(i)}>{c}</{tag}>" for i, c in enumerate(row))
    top = f"<thead><tr>{cells(map(_text, head), 'th')}</tr></thead>" if any(head) else ""
    body = "".join(f"<tr>{cells(row, 'td')}</tr>" for row in rows)
    return f'<div class="wide"><table>{top}<tbody>{body}</tbody></table></div>'


def _section(title: str, content: str, note: str = "") -> str:
    if not content and not note:
        return ""
    figure = f"<figure>{content}</figure>" if content.startswith("<svg") else content
    return f"<section><h2>{_text(title)}</h2>{figure}" + (
        f'<p class="note">{_text(note)}</p></section>' if note else "</section>"
    )


def _headline(attrs: dict[str, Any]) -> str:
    low, high = attrs["success_rate_bounds"]
    cards = [
        (f"{100 * attrs['success_rate']:.6g} %", "succeeded",
         f"{100 * low:.4f} to {100 * high:.4f} % at 95 % confidence (Wilson)"),
    ]  # fmt: skip
    miss = attrs["percentiles"].get("miss")
    if miss:
        p99 = miss["p99"]
        bounds = f"{_number(p99['low'], 4)} to {_number(p99['high'], 4)} at 95 %"
        cards.append((_number(p99["value"], 4), "99th percentile of the miss", bounds))
        cards.append((_number(miss["mean"], 4), "mean miss", "of the successful flights"))
    inner = "".join(
        f"<div><strong>{_text(a)}</strong><span>{_text(b)}</span><small>{_text(c)}</small></div>"
        for a, b, c in cards
    )
    return f'<div class="cards">{inner}</div>'


def _inputs(manifest: dict[str, Any], attrs: dict[str, Any]) -> str:
    about = attrs["about"]
    flights = _number(attrs["flown"])
    if attrs["flown"] < manifest["cases"]:
        flights += f" of {manifest['cases']:,}; stopped by {_text(manifest['stop'])}"
    plant = {k: v for k, v in about["plant"].items() if k not in ("class", "controls")}
    numbers = ", ".join(f"{k} = {_value(v)}" for k, v in plant.items())
    rows = [
        ("mission", _text(manifest.get("label") or "not of the library")),
        ("plant", f"{_text(about['plant']['class'])}<br><small>{_text(numbers)}</small>"),
        ("law", f"{_text(about['law'])}, sampled {_sampling(about['sample_interval'])}"),
        ("flights", flights),
        ("seed, sampling", f"{manifest['seed']}, {_text(attrs['sampling'].replace('_', ' '))}"),
        ("precision", _text(manifest["dtype"])),
        ("kept", _text(manifest["keep"])),
    ]
    drawn_by = [
        (f"<code>{_text(k)}</code>", _dispersion(v)) for k, v in about["dispersions"].items()
    ]
    spread = _table(("added to", "drawn from"), drawn_by, 2)
    return _section("What was flown", f"{_table(('', ''), rows, 2)}<h3>Dispersions</h3>{spread}")


def _dispersion(table: Any) -> str:
    if isinstance(table, str):
        return _text(table)
    inner = ", ".join(
        f"{k} {_dispersion(v) if isinstance(v, dict) else _text(_value(v))}"
        for k, v in table.items()
        if k != "kind"
    )
    return f"{_text(table['kind'])}: {inner}"


def _value(value: Any) -> str:
    if isinstance(value, list):
        return "[" + ", ".join(_value(v) for v in value) + "]"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _failures(attrs: dict[str, Any]) -> str:
    if not attrs["failures"]:
        return _section("Failures", "<p>None.</p>")
    rows = [
        (_text(name.replace("_", " ")), _text(str(RESULTS[getattr(RESULTS, name)])), f"{count:,}",
         f"{100 * count / attrs['flown']:.4g} %")
        for name, count in sorted(attrs["failures"].items(), key=lambda item: -item[1])
    ]  # fmt: skip
    return _section("Failures", _table(("reason", "what it means", "flights", "share"), rows, 2))


def _percentiles(attrs: dict[str, Any]) -> str:
    percentiles = attrs["percentiles"]
    if not percentiles:
        return ""
    linear = dict(zip(attrs["quantities"], _roots(attrs["linear_covariance"]), strict=False))
    linear.pop("miss", None)
    values = {
        "mean": {name: row["mean"] for name, row in percentiles.items()},
        "standard deviation": {name: row["std"] for name, row in percentiles.items()},
        "the same, linear": linear,
    }
    rows: list[tuple] = [
        (word, *(_number(of[name]) if name in of else "" for name in percentiles))
        for word, of in values.items()
    ]
    for key in (key for key in next(iter(percentiles.values())) if key.startswith("p")):
        rows.append((f"{key[1:]} %", *(_bounded(row[key]) for row in percentiles.values())))
    note = (
        "Of the successful flights. Below each percentile its 95 % bounds, by order statistics; "
        "none: too few flights for one."
    )
    return _section("Statistics of the end", _table(("", *percentiles), rows), note)


def _bounded(percentile: dict[str, float]) -> str:
    low, high = (_number(percentile[k], 6) for k in ("low", "high"))
    return f"{_number(percentile['value'], 6)}<br><small>{low} to {high}</small>"


def _roots(covariance: list[list[float]]) -> list[float]:
    return [max(row[i], 0.0) ** 0.5 for i, row in enumerate(covariance)]


def _dots(cases: dict[str, Any], attrs: dict[str, Any]) -> str:
    if not cases:
        return "The store keeps a summary, no single flights, so none are drawn here."
    shown = len(cases["result"])
    return f"Dots: the first {shown:,} successful flights of {attrs['flown']:,}."


def _kept(data: Any) -> str:
    if "history_x" not in data:
        return (
            "No flights were kept in full; sweep with --histories 200 (and --failures 20 for "
            "failed ones) to see how they went."
        )
    count = data.sizes["history"]
    bad = int((data["history_result"].values != 0).sum())
    return f"Percentiles over time of {count - bad} successful flights; {bad} failed ones in red."


def _worst(attrs: dict[str, Any], manifest: dict[str, Any], store: Path) -> str:
    rows = []
    for row in attrs["worst"][:_WORST]:
        again = f"jaxguide sweep rerun {shlex.quote(str(store))} {row['case']} --out figures"
        if manifest.get("label") is None:
            again = f"jg.rerun(mission, dispersions, {manifest['seed']}, {row['case']})"
        rows.append(
            (f"{row['case']:,}", _number(row["measure"]), _text(row["result"]),
             f"<code>{_text(again)}</code>")
        )  # fmt: skip
    what = "miss" if "miss" in attrs["quantities"] else "deviation [linear sigma]"
    return _section("Worst flights", _table(("case", what, "result", "fly it again"), rows, 0))
