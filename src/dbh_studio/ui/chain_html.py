"""The HTML of the last search: its steps in numbers, the sizes of its clusters, and what was dropped and why."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime

import numpy as np

from dbh_studio.core.arrays import Float64, Int64
from dbh_studio.core.chain_advice import Advice, Story, story_of_cluster, story_of_miss
from dbh_studio.core.chain_steps import ChainSteps, Cluster, Step
from dbh_studio.ui.bridge import call, esc, js

# Okabe and Ito's colours, told apart with every kind of colour vision; greys for what was never in question.
STEP_COLOURS: Mapping[Step, tuple[int, int, int]] = {
    Step.NO_CANDIDATE: (176, 180, 184),
    Step.TOO_LOW: (148, 132, 112),
    Step.TOO_HIGH: (212, 216, 212),
    Step.NOT_SIDEWAYS: (86, 180, 233),
    Step.LOOSE: (240, 228, 66),
    Step.DROPPED: (213, 94, 0),
    Step.KEPT: (0, 158, 115),
    Step.JOINED: (0, 114, 178),
}
_WIDTH, _HEIGHT, _LEFT, _RIGHT, _BASE, _TALLEST = 340, 132, 26, 14, 100, 82
_MOST_BINS, _MOST_LISTED = 24, 12


def step_title(step: Step, steps: ChainSteps) -> str:
    """What a step is called in the legend."""
    settings = steps.settings
    return {
        Step.NO_CANDIDATE: "in no mask" if steps.from_masks else "on no stem seen",
        Step.TOO_LOW: f"lower than {settings.ground_clearance_m:g} m",
        Step.TOO_HIGH: f"higher than {settings.trunk_top_m:g} m",
        Step.NOT_SIDEWAYS: "not facing sideways",
        Step.LOOSE: "in no cluster",
        Step.DROPPED: "cluster dropped",
        Step.KEPT: "cluster kept",
        Step.JOINED: "joined by expansion",
    }[step]


def colour(step: Step) -> str:
    """Of a step, for CSS."""
    return "#{:02x}{:02x}{:02x}".format(*STEP_COLOURS[step])


# ---- the legend in the picture


def legend(steps: ChainSteps, shown: frozenset[Step]) -> str:
    """One button per step that has points: what it is, how many, and whether it is on."""
    buttons = "".join(
        f'<button type="button" data-chain-step="{int(step)}" aria-pressed="{"true" if step in shown else "false"}" '
        f'title="Show or hide" onclick="{call("chain_step", int(step))}">'
        f'<i style="background:{colour(step)}"></i><span>{esc(step_title(step, steps))}</span>'
        f"<b>{steps.counts[step]:,}</b></button>"
        for step in Step
        if steps.counts[step]
    )
    return f"<h4>Steps of the last search</h4>{buttons}<small>Click a point to learn why.</small>"


def legend_js(content: str) -> str:
    """JavaScript that puts the legend into the corner of the picture, or takes it away where `content` is empty."""
    return (
        "(()=>{let e=document.getElementById('dbh-chain');"
        f"const c={js(content)};if(!c){{if(e)e.remove();return;}}"
        "if(!e){e=document.createElement('div');e.id='dbh-chain';e.className='dbh';document.body.appendChild(e);}"
        "e.innerHTML=c;})()"
    )


# ---- the panel


def about(when: datetime, steps: ChainSteps, n_trunks: int, remarks: Sequence[str]) -> str:
    """Of which search the steps are, and in what the plot has changed since."""
    way = "with the masks of photos" if steps.from_masks else "by geometry"
    trunks = "1 trunk" if n_trunks == 1 else f"{n_trunks} trunks"
    changed = "".join(f'<li data-level="note">{esc(remark)}</li>' for remark in remarks)
    return (
        f'<div class="dbh"><div class="muted">Search of {when.astimezone():%d %B %Y, %H:%M}, {way}: {trunks}.</div>'
        f"{f'<ul class=dbh-list>{changed}</ul>' if changed else ''}</div>"
    )


def step_table(steps: ChainSteps) -> str:
    """How many points were left after each step, and how many it lost."""
    rows = [("All points", steps.n_points)]
    heights = "Within the heights"
    if steps.from_masks:
        rows += [("In a mask", steps.n_candidates), (heights, steps.n_above_ground)]
    else:
        outside = steps.n_before_expansion(Step.TOO_LOW) + steps.n_before_expansion(Step.TOO_HIGH)
        rows += [(heights, steps.n_points - outside), ("On a stem seen", steps.n_candidates)]
    rows += [
        ("Facing sideways", steps.n_facing_sideways),
        ("In a cluster", steps.n_clustered),
        ("In a cluster kept", steps.n_in_clusters),
        ("With what joined", steps.n_expanded),
    ]
    body = "".join(
        f'<tr><td class="text">{esc(name)}</td><td>{n:,}</td><td>{_difference(n - before)}</td></tr>'
        for (name, n), before in zip(rows, [steps.n_points, *(n for _, n in rows)], strict=False)
    )
    return (
        '<div class="dbh"><table class="dbh-table dbh-chain-table"><thead><tr><th class="text">Step</th>'
        f"<th>Points</th><th>Change</th></tr></thead><tbody>{body}</tbody></table></div>"
    )


def _difference(n: int) -> str:
    return "" if not n else f"+{n:,}" if n > 0 else f"\N{MINUS SIGN}{-n:,}"


def histogram(steps: ChainSteps) -> str:
    """How many clusters of which size there were, kept and dropped, and where the threshold lay; an inline SVG."""
    if not steps.clusters:
        return '<div class="dbh muted">There was no cluster.</div>'
    size = np.log10([max(cluster.n_points, 1) for cluster in steps.clusters])
    kept = np.array([cluster.kept for cluster in steps.clusters])
    axis = _Axis.of(size, steps.size_threshold)
    n_kept, n_dropped = (np.bincount(axis.bins(size[chosen]), minlength=axis.n_bins) for chosen in (kept, ~kept))
    top = int((n_kept + n_dropped).max())
    bars = []
    for k in range(axis.n_bins):
        y = float(_BASE)
        for count, step in ((n_kept[k], Step.KEPT), (n_dropped[k], Step.DROPPED)):
            if count:
                height = max(_TALLEST * count / top, 3.0)
                y -= height
                bars.append(
                    f'<rect x="{_LEFT + k * axis.bin_px + 0.5:.1f}" y="{y:.1f}" width="{axis.bin_px - 1:.1f}" '
                    f'height="{height:.1f}" fill="{colour(step)}"/>'
                )
    ticks = "".join(
        f'<text x="{axis.x(math.log10(number)):.1f}" y="{_BASE + 15}" text-anchor="middle">{_short(number)}</text>'
        for number in axis.ticks()
    )
    return (
        f'<div class="dbh dbh-sizes"><svg viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" '
        f'aria-label="Sizes of {len(size)} clusters"><path d="M{_LEFT} {_BASE}H{_WIDTH - _RIGHT}" stroke="#868e96"/>'
        f'{"".join(bars)}{_threshold(steps, axis)}{ticks}<text x="{_LEFT - 5}" y="{_BASE - _TALLEST + 8}" '
        f'text-anchor="end">{top}</text><text x="{_LEFT - 5}" y="{_BASE}" text-anchor="end">0</text>'
        f'<text x="{_WIDTH - _RIGHT}" y="{_BASE + 29}" text-anchor="end">points in a cluster</text></svg>'
        f'<div class="dbh-dots"><span><i style="background:{colour(Step.KEPT)}"></i>{int(kept.sum())} kept</span>'
        f'<span><i style="background:{colour(Step.DROPPED)}"></i>{int((~kept).sum())} dropped</span></div></div>'
    )


@dataclass(frozen=True)
class _Axis:
    """Powers of ten from left to right, in bins."""

    low: float
    per_decade: int
    n_bins: int

    @classmethod
    def of(cls, size: Float64, threshold: float) -> _Axis:
        """Wide enough for all sizes, with the threshold between two bins: none is on both sides of it."""
        edge = math.log10(max(threshold, 1.0)) if math.isfinite(threshold) else 0.0
        low, high = min(size.min(), edge), max(size.max(), edge)
        per_decade = int(np.clip(_MOST_BINS // (high - low + 1.0), 1, 8))
        # A bin less than needed on the left, so that the smallest bar stands free of the axis' end.
        first = math.floor((low - edge) * per_decade) - 1
        n_bins = math.floor((high - edge) * per_decade) + 2 - first
        return cls(edge + first / per_decade, per_decade, n_bins)

    @property
    def high(self) -> float:
        """Power of ten at the right end."""
        return self.low + self.n_bins / self.per_decade

    @property
    def bin_px(self) -> float:
        """Width of a bin."""
        return (_WIDTH - _LEFT - _RIGHT) / self.n_bins

    def x(self, power: float) -> float:
        """Where a power of ten is."""
        return _LEFT + (power - self.low) * self.per_decade * self.bin_px

    def ticks(self) -> list[int]:
        """Round numbers along the axis: where it is short, 2 and 5 times a power of ten too."""
        factors = (1, 2, 5) if self.high - self.low < 2.0 else (1,)
        numbers = [
            n * 10**power for power in range(max(math.floor(self.low), 0), math.ceil(self.high)) for n in factors
        ]
        return [number for number in numbers if self.low <= math.log10(number) <= self.high]

    def bins(self, size: Float64) -> Int64:
        """(N,) bin of (N,) powers of ten; a rounding error takes none across the threshold."""
        return np.clip(np.floor((size - self.low) * self.per_decade + 1e-9), 0, self.n_bins - 1).astype(np.int64)


def _threshold(steps: ChainSteps, axis: _Axis) -> str:
    if not math.isfinite(steps.size_threshold):
        return ""
    x = axis.x(math.log10(max(steps.size_threshold, 1.0)))
    name = "smallest" if steps.settings.smallest_cluster_points else "Otsu"
    anchor, shift = ("end", -5) if x > 0.6 * _WIDTH else ("start", 5)
    return (
        f'<path d="M{x:.1f} 2V{_BASE}" stroke="#212529" stroke-width="1.5" stroke-dasharray="4 3"/>'
        f'<text x="{x + shift:.1f}" y="11" text-anchor="{anchor}">{name} {math.ceil(steps.size_threshold):,}</text>'
    )


def _short(number: int) -> str:
    for unit, letter in ((10**9, "G"), (10**6, "M"), (10**3, "k")):
        if number >= unit:
            return f"{number // unit}{letter}"
    return str(number)


def lost(steps: ChainSteps) -> str:
    """What was dropped, largest first, each with why and with what would bring it back; then the near misses."""
    clusters = [
        _item("cluster", k, _cluster_words(steps.clusters[k]), story_of_cluster(steps, k))
        for k in steps.dropped[:_MOST_LISTED]
    ]
    misses = [
        _item("miss", k, f"Nearly a stem: {100 * miss.diameter_m:.0f} cm thick", story_of_miss(steps, miss))
        for k, miss in enumerate(steps.near_misses[:_MOST_LISTED])
    ]
    if not clusters and not misses:
        return '<div class="dbh muted">No cluster was dropped, and nothing was nearly a stem.</div>'
    more = len(steps.dropped) + len(steps.near_misses) - len(clusters) - len(misses)
    rest = f'<div class="muted">and {more:,} smaller</div>' if more else ""
    return f'<div class="dbh"><h4 class="dbh-lost-head">Lost</h4>{"".join(clusters + misses)}{rest}</div>'


def _cluster_words(cluster: Cluster) -> str:
    place = f"{cluster.low_m:.1f} to {cluster.high_m:.1f} m up"
    return f"{cluster.width_m:.1f} m wide, {place}, {cluster.n_points:,} points"


def _item(kind: str, number: int, title: str, story: Story) -> str:
    return (
        f'<div class="dbh-lost" data-lost="{kind}-{number}"><div class="dbh-lost-title"><b>{esc(title)}</b>'
        f'<button type="button" data-go="{kind}-{number}" onclick="{call("chain_go", [kind, number])}">Go there'
        f"</button></div><div>{esc(story.text)}</div>{_advice(kind, number, story.advice)}</div>"
    )


def _advice(kind: str, number: int, advice: Sequence[Advice]) -> str:
    lines = []
    for k, one in enumerate(advice):
        button = ""
        if one.changes:
            button = (
                f'<button type="button" data-try="{kind}-{number}-{k}" title="Fill it into the settings below" '
                f'onclick="{call("chain_try", [kind, number, k])}">Try it</button>'
            )
        lines.append(f"<li><span>{esc(one.text)}</span>{button}</li>")
    return f"<ul>{''.join(lines)}</ul>" if lines else ""


def story_box(title: str, story: Story) -> str:
    """What became of the point that was clicked."""
    return (
        f'<div class="dbh"><div class="dbh-hint dbh-story" data-level="todo" '
        f'style="border-left-color:{colour(story.step)}"><b>{esc(title)}</b><br>{esc(story.text)}'
        f"{_advice('point', 0, story.advice)}</div></div>"
    )
