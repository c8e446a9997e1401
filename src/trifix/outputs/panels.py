"""The viewer's words and numbers as pieces of HTML: pure text from plain values; knows no server and no scene.

Colours come from the page's theme, light or dark; what a colour says, a word or a mark says too.
"""

import math
from collections.abc import Mapping, Sequence
from html import escape

import numpy as np
from jaxtyping import Bool, Float, Int

from trifix.outputs.finished import Sightings
from trifix.outputs.moments import DOT_COLOUR, Moment
from trifix.outputs.scene3d import COLOUR, PLACE, css, ramp_css, residual_colours
from trifix.records import PositionedReason, Reason, ReferenceMap, TargetState

_MOST_BARS = 400
_HEIGHT = 44
_SENTENCE = {each.name: each.value for each in (*Reason, *PositionedReason)}

STYLE = f"""<style>
.tf {{ padding: 2px 12px 8px; font-size: 13px; line-height: 1.4; }}
.tf p {{ margin: 0; }}
.tf .dim, .tf-dim {{ color: var(--mantine-color-dimmed); }}
.tf-status {{ display: grid; grid-template-columns: 40px 1fr; gap: 12px; align-items: center; border-radius: 10px;
  padding: 12px; background: color-mix(in srgb, var(--light) 12%, transparent);
  border: 1px solid color-mix(in srgb, var(--light) 45%, transparent); min-height: 92px; }}
.tf-good {{ --light: {css(COLOUR[TargetState.trusted])}; }}
.tf-special {{ --light: #d99a1c; }}
.tf-bad {{ --light: {css(COLOUR[TargetState.quarantined])}; }}
.tf-none {{ --light: #8b95a1; }}
.tf-light {{ width: 40px; height: 40px; border-radius: 50%; display: grid; place-items: center; color: #fff;
  font-size: 20px; font-weight: 700; background: var(--light);
  box-shadow: 0 0 0 5px color-mix(in srgb, var(--light) 22%, transparent); }}
.tf-status b {{ font-size: 16px; font-weight: 650; }}
.tf-advice {{ margin-top: 8px; border-radius: 10px; padding: 9px 12px; min-height: 55px;
  border: 1px solid color-mix(in srgb, {css(PLACE)} 45%, transparent);
  background: color-mix(in srgb, {css(PLACE)} 9%, transparent); }}
.tf-advice.empty {{ border-style: dashed; border-color: color-mix(in srgb, currentColor 18%, transparent);
  background: none; display: grid; align-items: center; }}
.tf-tiles {{ display: grid; grid-template-columns: repeat(3, 1fr); gap: 10px 12px; margin: 4px 0 0; }}
.tf-tiles dt {{ color: var(--mantine-color-dimmed); font-size: 11.5px; }}
.tf-tiles dd {{ margin: 0; font-size: 18px; font-weight: 600; white-space: nowrap;
  font-variant-numeric: tabular-nums; }}
.tf-tiles small {{ font-size: 11.5px; font-weight: 400; color: var(--mantine-color-dimmed); }}
.tf-tiles sup {{ font-size: 0.65em; line-height: 0; }}
.tf-line {{ margin-top: 9px !important; font-variant-numeric: tabular-nums; font-size: 12px; }}
.tf-legend {{ display: flex; flex-wrap: wrap; gap: 3px 14px; font-size: 12px; }}
.tf-legend svg {{ width: 15px; height: 15px; vertical-align: -3px; margin-right: 5px; overflow: visible; }}
.tf-ramp {{ height: 8px; border-radius: 4px; background: {ramp_css()}; margin: 5px 0 1px; }}
.tf-ends {{ display: flex; justify-content: space-between; font-size: 11.5px; }}
.tf h4 {{ margin: 10px 0 3px; font-size: 12px; font-weight: 650; }}
.tf-strip {{ display: block; width: 100%; height: {_HEIGHT}px; overflow: visible; }}
.tf-strip .now {{ stroke: var(--mantine-color-text); stroke-width: 2; vector-effect: non-scaling-stroke; }}
.tf-strip .ground {{ fill: currentColor; opacity: 0.06; }}
.tf table {{ border-collapse: collapse; width: 100%; font-size: 12px; font-variant-numeric: tabular-nums; }}
.tf th {{ text-align: right; font-weight: 500; color: var(--mantine-color-dimmed); padding: 2px 0 2px 6px; }}
.tf td {{ text-align: right; padding: 2px 0 2px 6px;
  border-top: 1px solid color-mix(in srgb, currentColor 12%, transparent); }}
.tf th:first-child, .tf td:first-child {{ text-align: left; padding-left: 0; }}
.tf tr.here td {{ font-weight: 650; }}
</style>"""


def status(moment: Moment | None) -> str:
    """The light, the reason as a sentence, and what to do about it."""
    if moment is None:
        return (
            STYLE + '<div class="tf"><div class="tf-status tf-none" role="status"><span class="tf-light">…</span>'
            "<div><b>Waiting</b><p>No frame has come in yet.</p></div></div></div>"
        )
    kind, mark, word = ("bad", "✕", "Refused")
    if moment.is_positioned:
        kind, mark, word = (
            ("special", "≈", "Positioned") if moment.reason == "few_points" else ("good", "✓", "Positioned")
        )
    agree = f"{moment.matched} of {moment.points} points agree with the map."
    sentence = escape(_SENTENCE.get(moment.reason, agree if moment.is_positioned else ""))
    detail = f'<p class="dim">{escape(moment.detail)}</p>' if moment.detail else ""
    advice = '<div class="tf-advice empty dim">Nothing to do: go on.</div>'
    if moment.advice is not None:
        advice = f'<div class="tf-advice"><b>To do</b><p>{escape(moment.advice.sentence)}</p></div>'
    return (
        f'{STYLE}<div class="tf"><div class="tf-status tf-{kind}" role="status"><span class="tf-light">{mark}</span>'
        f'<div><b>{word}</b> <span class="dim">frame {moment.frame}</span> <p>{sentence}</p>{detail}</div></div>'
        f"{advice}</div>"
    )


def numbers(moment: Moment | None, frames_per_s: float, latency_ms: float, dropped: int) -> str:
    """The frame in numbers."""
    if moment is None:
        return ""
    residual = _number(moment.residual_mm, 3)
    tiles = [
        ("Points", str(moment.points), ""),
        ("Matched", str(moment.matched), ""),
        ("Residual, rms", residual, "mm" if residual != "–" else ""),
        ("Chance", _chance(moment.p_chance), ""),
        ("Frames/s", _number(frames_per_s, 1), f"{dropped} dropped" if dropped else ""),
        ("Latency", _number(latency_ms, 1), "ms"),
    ]
    cells = "".join(f"<div><dt>{name}</dt><dd>{value} <small>{unit}</small></dd></div>" for name, value, unit in tiles)
    line = "The sensor has not been found yet."
    if moment.pose is not None:
        xyz = ", ".join(_number(float(each), 1) for each in moment.pose.t_mm)
        sigma = "" if math.isnan(moment.sigma_mm) else f" ± {_number(moment.sigma_mm, 3)}"
        line = f"{'Sensor at' if moment.is_positioned else 'Sensor last at'} ({xyz}){sigma} mm"
    events = "".join(f"<p>{escape(each)}</p>" for each in moment.events[:3])
    happened = f"<h4>What happened to the map</h4>{events}" if events else ""
    return f'<div class="tf"><dl class="tf-tiles">{cells}</dl><p class="tf-line dim">{line}</p>{happened}</div>'


def dots_legend(moment: Moment | None) -> str:
    """What the marks in the images mean, with how many of each there are in the left one."""
    if moment is None or not moment.shots:
        return (
            '<div class="tf dim">No images or dots to show: name the folder of the recording with --recording.</div>'
            if moment is not None
            else ""
        )
    meanings = {
        "identified": ("identified", '<circle cx="10" cy="10" r="7"/>'),
        "unidentified": ("not identified", '<path d="M10 1l9 9l-9 9l-9-9z"/>'),
        "refused": ("of a refused frame", '<path d="M3 3h14v14h-14z"/>'),
        "single": ("seen by one camera", '<path d="M5 5l10 10M15 5l-10 10"/>'),
    }
    rows = []
    for kind, (words, mark) in meanings.items():
        counts = [len(shot.dots.get(kind, ())) for shot in moment.shots]
        if any(counts):
            drawing = (
                f'<svg viewBox="0 0 20 20" fill="none" stroke-width="3" stroke="{css(DOT_COLOUR[kind])}">{mark}</svg>'
            )
            rows.append(f"<span>{drawing}{' + '.join(map(str, counts))} {words}</span>")
    return f'<div class="tf"><div class="tf-legend">{"".join(rows)}</div></div>'


def scene_legend(targets: ReferenceMap, worst_mm: float) -> str:
    """What the shapes and colours in space mean."""
    marks = {
        TargetState.trusted: '<circle cx="10" cy="10" r="8" fill="{}"/>',
        TargetState.provisional: '<circle cx="10" cy="10" r="7" fill="none" stroke="{}" stroke-width="4"/>',
        TargetState.quarantined: '<path d="M3 3l14 14M17 3l-14 14" stroke="{}" stroke-width="4"/>',
    }
    rows = "".join(
        f'<span><svg viewBox="0 0 20 20">{mark.format(css(COLOUR[state]))}</svg>'
        f"{int((targets.state == state).sum())} {state.name}</span>"
        for state, mark in marks.items()
    )
    return (
        f'<div class="tf"><h4>Targets</h4><div class="tf-legend">{rows}</div>'
        f'<h4>Path, by residual</h4><div class="tf-ramp"></div>'
        f'<div class="tf-ends dim"><span>0</span><span>gaps where refused</span><span>{worst_mm:g} mm or more</span>'
        "</div></div>"
    )


def strip(
    is_positioned: Bool[np.ndarray, "n"],
    residual_mm: Float[np.ndarray, "n"],
    is_meant: Bool[np.ndarray, "n"],
    worst_mm: float,
) -> str:
    """A bar a frame, or a few: residuals from below, refusals from top to bottom; what is not meant is faint.

    It lacks its end, which ``with_now`` adds.
    """
    n = len(is_positioned)
    size = max(-(-n // _MOST_BARS), 1)
    bars = []
    for start in range(0, n, size):
        some = slice(start, start + size)
        width = min(size, n - start)
        faint = "" if is_meant[some].any() else ' opacity="0.25"'
        gap = 0.12 * width if n <= 120 else 0.0
        if not is_positioned[some].all():
            colour, height = css(COLOUR[TargetState.quarantined]), float(_HEIGHT)
        else:
            residual = float(np.nanmax(np.r_[0.0, residual_mm[some]]))
            colour = css(residual_colours(np.array([residual]), worst_mm)[0])
            height = 4 + (_HEIGHT - 14) * min(residual / worst_mm, 1.0)
        bars.append(
            f'<rect x="{start + gap / 2:g}" y="{_HEIGHT - height:.1f}" width="{width - gap:g}" height="{height:.1f}" '
            f'fill="{colour}"{faint}/>'
        )
    ground = f'<rect class="ground" x="0" y="0" width="{n}" height="{_HEIGHT}"/>'
    return (
        f'<div class="tf"><svg class="tf-strip" viewBox="0 0 {n} {_HEIGHT}" preserveAspectRatio="none" '
        f'role="img" aria-label="Residual of every frame, refused ones full">{ground}{"".join(bars)}'
    )


def with_now(strip: str, k: int, words: str) -> str:
    """A strip with a line where it is now, and words below."""
    line = f'<line class="now" x1="{k + 0.5}" x2="{k + 0.5}" y1="-5" y2="{_HEIGHT + 3}"/>'
    return f'{strip}{line}</svg><div class="tf-ends" style="margin-top:5px">{words}</div></div>'


def reasons_found(reason: Sequence[str], is_positioned: Bool[np.ndarray, "n"]) -> Mapping[str, Bool[np.ndarray, "n"]]:
    """What frames can be asked for, in words with their number, and which they are; the refused ones first."""
    names = np.array(reason, dtype=object)
    choices = {"any refused frame": ~is_positioned} if not is_positioned.all() else {}
    choices |= {name.replace("_", " "): names == name for name in dict.fromkeys(reason) if name}
    choices = {**choices, "any frame": np.ones(len(names), dtype=bool)}
    if is_positioned.all():
        choices = dict(reversed(choices.items()))
    return {f"{words} ({int(meant.sum())})": meant for words, meant in choices.items()}


def target_card(target: int, targets: ReferenceMap, sightings: Sightings, frame: int, most: int = 7) -> str:
    """A target: where it is, how well that is known, and its sightings with their residuals around this frame."""
    rows = np.flatnonzero(targets.id == target)
    if not len(rows) and not len(sightings.frame):
        return f'<div class="tf dim">There is no target {target}.</div>'
    lines = []
    if len(rows):
        row = int(rows[0])
        sigma = np.sqrt(np.maximum(np.linalg.eigvalsh(targets.cov_mm2[row]), 0.0))
        xyz = ", ".join(_number(float(each), 2) for each in targets.xyz_mm[row])
        state = TargetState(int(targets.state[row])).name
        lines.append(
            f"<p><b>Target {target}</b>, {state}, at ({xyz}) mm, ±\u00a0{_number(float(sigma[-1]), 3)}\u00a0mm</p>"
        )
    else:
        lines.append(f"<p><b>Target {target}</b>, no longer in the map</p>")
    count = len(sightings.frame)
    if not count:
        return f'<div class="tf">{"".join(lines)}<p class="dim">No positioned frame shows it.</p></div>'
    known = sightings.residual_mm[np.isfinite(sightings.residual_mm)]
    figures = f"{count} sighting{'' if count == 1 else 's'}, frames {sightings.frame[0]} to {sightings.frame[-1]}"
    if len(known):
        worst = int(sightings.frame[int(np.nanargmax(sightings.residual_mm))])
        figures += (
            f"; rms {_number(float(np.sqrt(np.mean(known**2))), 3)} mm, largest {_number(float(known.max()), 3)} mm"
        )
        figures += f" in frame {worst}"
    lines.append(f'<p class="dim">{figures}</p>')
    lines.append(_spark(sightings, frame))
    at = int(np.searchsorted(sightings.frame, frame))
    start = max(min(at - most // 2, count - most), 0)
    body = "".join(
        f"<tr{' class=here' if sightings.frame[k] == frame else ''}><td>{sightings.frame[k]}</td>"
        f"<td>{sightings.cameras[k]}</td><td>{_number(float(sightings.residual_mm[k]), 3)}</td>"
        f"<td>{_number(float(sightings.residual_px[k]), 3)}</td></tr>"
        for k in range(start, min(start + most, count))
    )
    head = "<tr><th>frame</th><th>seen by</th><th>mm</th><th>px</th></tr>"
    return f'<div class="tf">{"".join(lines)}<table>{head}{body}</table></div>'


def next_run(advice: Sequence[str]) -> str:
    """What would help the next run over the same object."""
    if not advice:
        return ""
    return f'<div class="tf"><h4>For the next run</h4>{"".join(f"<p>{escape(each)}</p>" for each in advice)}</div>'


def _spark(sightings: Sightings, frame: int) -> str:
    """The residuals of a target's sightings over time."""
    mm = sightings.residual_mm
    top = float(np.nanmax(np.r_[1e-9, mm]))
    first, last = int(sightings.frame[0]), int(sightings.frame[-1])
    span = max(last - first, 1)
    colours = residual_colours(mm, top)
    pick = np.unique(np.linspace(0, len(mm) - 1, 300).astype(int))
    dots = "".join(
        f'<circle cx="{300 * (sightings.frame[k] - first) / span:.1f}" cy="{34 - 30 * mm[k] / top:.1f}" r="2.2" '
        f'fill="{css(colours[k])}"/>'
        for k in pick
        if math.isfinite(mm[k])
    )
    here = 300 * min(max((frame - first) / span, 0.0), 1.0)
    return (
        '<svg viewBox="-4 0 308 40" style="width:100%;display:block;margin:6px 0 2px" role="img" '
        f'aria-label="Residuals of its sightings"><line x1="0" x2="300" y1="36" y2="36" stroke="currentColor" '
        f'opacity="0.2"/><line x1="{here:.1f}" x2="{here:.1f}" y1="2" y2="38" stroke="currentColor" opacity="0.5"/>'
        f"{dots}</svg>"
    )


def _number(value: float, decimals: int) -> str:
    return "–" if math.isnan(value) else f"{value:.{decimals}f}".replace("-", "−")


def _chance(p: float) -> str:
    """A probability, as a power of ten where it is small."""
    if math.isnan(p):
        return "–"
    if p >= 0.001:
        return f"{p:.3f}"
    if p <= 0:
        return "0"
    return f"10<sup>−{-math.floor(math.log10(p)) - 1}</sup>"


def frame_words(frames: Int[np.ndarray, "n"], k: int, is_finished: bool) -> str:
    """Which frame of which is shown."""
    end = "" if is_finished else " · <b>this run did not reach its end</b>"
    return (
        f"<span>frame <b>{frames[k]}</b>{end}</span>"
        f'<span class="dim">{k + 1} of {len(frames)}, numbers {frames[0]} to {frames[-1]}</span>'
    )
