"""What else is in a section: heaps without a stem, several stems in one, ferns about one; and what is made of it.

    python bench/estimator_section.py                       the tables, 40 of each kind
    python bench/estimator_section.py -n 60 --first 10000   60 of each kind, seeds from 10 000 on
    python bench/estimator_section.py --calibrate           fit the odds of clutter (`core.estimator.heap`)

Nothing in a heap has a diameter, so every one that gets a number counts against the program. Stems are those of
`estimator_stems`; of these every one counts that is refused for what is beside it.
"""

from __future__ import annotations

import argparse
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from estimator_heaps import HEAPS, make_heap
from estimator_stems import SCENARIOS, Scenario, clutter_about, in_stretch, make_case, seen_of, stem_of

from dbh_studio.core.dbh import measure_stem
from dbh_studio.core.estimator import assess_stem
from dbh_studio.core.estimator.fit import fit_tube
from dbh_studio.core.estimator.heap import HeapSigns, signs_of
from dbh_studio.core.estimator.prior import StemPrior
from dbh_studio.core.estimator.ring_count import first_of, stems_of
from dbh_studio.core.estimator.sample import sample_points
from dbh_studio.core.estimator.search import search_rings
from dbh_studio.core.measured import Refusal
from dbh_studio.core.synthetic.stems import BREAST_HEIGHT_M, Stem
from dbh_studio.settings import EstimatorSettings, MeasureSettings

Rng = np.random.Generator
_RIGHT = 0.12  # relative error up to which it is that stem's diameter

# ---- several stems in one section


@dataclass(frozen=True, eq=False)
class Section:
    """Several stems as seen together: (N, 3) points, (S, 2) centres at 1.30 m, (S,) girth/π, (S,) points of each."""

    points_m: np.ndarray
    centres_m: np.ndarray
    tape_cm: np.ndarray
    n_points: np.ndarray


SECTIONS = {"twins": 2, "fork": 2, "three stems": 3}
_TWO_RINGS = Scenario(arc_deg=(200, 340), dbh_cm=(10, 45), points=(1500, 9000), clutter=(0.0, 0.15))


def make_section(
    kind: str, seed: int, *, gap_m: float | None = None, ratio: float | None = None, share: float | None = None
) -> Section:
    """Stems of one tree, or of neighbours, in one cluster.

    Args:
        kind: One of `SECTIONS`.
        seed: Of all that is random.
        gap_m: Bark to bark at breast height; None draws 0-25 cm.
        ratio: Of the other stems' diameters to the first one's; None draws 0.5-1.
        share: Of points on each other stem relative to the first; None draws 0.3-1.
    """
    rng = np.random.default_rng([seed, zlib.crc32(kind.encode())])
    first = stem_of(_TWO_RINGS, seed, rng)
    n_points = int(np.exp(rng.uniform(*np.log(_TWO_RINGS.points))))
    turn = rng.uniform(0, 2 * np.pi)
    stems, counts = [first], [n_points]
    for k in range(1, SECTIONS[kind]):
        size = rng.uniform(0.5, 1.0) if ratio is None else ratio
        apart = rng.uniform(0.0, 0.25) if gap_m is None else gap_m
        towards = np.array([np.cos(turn + 2.1 * k), np.sin(turn + 2.1 * k)])
        stems.append(_second(first, size, apart, towards, rng, forks=kind == "fork"))
        counts.append(int(n_points * (rng.uniform(0.3, 1.0) if share is None else share)))
    parts = [
        _outside(seen_of(_TWO_RINGS, each, n, float(rng.uniform(*_TWO_RINGS.arc_deg)), rng), stems, k)
        for k, (each, n) in enumerate(zip(stems, counts, strict=True))
    ]
    own = np.array([int(in_stretch(part).sum()) for part in parts])
    parts += clutter_about(first, int(n_points * rng.uniform(*_TWO_RINGS.clutter)), rng)
    points = np.concatenate(parts)
    centres = np.array([each.axis(np.array([BREAST_HEIGHT_M]))[0, :2] for each in stems])
    tapes = np.array([each.diameters_cm(BREAST_HEIGHT_M)[0] for each in stems])
    return Section(points[rng.permutation(len(points))], centres, tapes, own)


def _second(first: Stem, size: float, apart_m: float, towards: np.ndarray, rng: Rng, *, forks: bool) -> Stem:
    """A stem beside another: upright beside it, or leaning away from where the two part below breast height."""
    other = replace(first, radius_m=size * first.radius_m, harmonics=first.harmonics * [1, 1, -1])
    here = np.array([BREAST_HEIGHT_M])
    reach = float(first.mean_radius(here)[0] + other.mean_radius(here)[0]) * 1.03 + apart_m
    lean = reach / rng.uniform(0.5, 1.0) if forks else rng.normal(0.0, 0.04)
    other = replace(other, lean=first.lean + lean * towards)
    place = first.axis(here)[0, :2] + reach * towards - other.axis(here)[0, :2]
    return replace(other, base=np.array([*(other.base[:2] + place), 0.0]))


def _outside(points: np.ndarray, stems: list[Stem], own: int) -> np.ndarray:
    """What is not within another stem: below a fork there is one."""
    keep = np.ones(len(points), bool)
    for k, stem in enumerate(stems):
        if k != own:
            off = (points - stem.axis(points[:, 2]))[:, :2]
            keep &= np.hypot(*off.T) > 0.95 * stem.mean_radius(np.maximum(points[:, 2], 0.0))
    return points[keep]


def make_ferns(seed: int) -> tuple[np.ndarray, float]:
    """(N, 3) points of a stem that stands in fern or a bush, and its girth/π: it must not be taken for a heap."""
    rng = np.random.default_rng([seed, zlib.crc32(b"ferns")])
    scenario = Scenario(arc_deg=(180, 360), dbh_cm=(10, 60), points=(800, 9000))
    stem = stem_of(scenario, seed, rng)
    n = int(np.exp(rng.uniform(*np.log(scenario.points))))
    bark = seen_of(scenario, stem, n, float(rng.uniform(*scenario.arc_deg)), rng)
    about = HEAPS[str(rng.choice(["fern", "round bush", "cloud of leaves"]))](rng, int(n * rng.uniform(0.2, 0.8)))
    about[:, :2] += stem.axis(np.array([BREAST_HEIGHT_M]))[0, :2]
    off = (about - stem.axis(about[:, 2]))[:, :2]
    about = about[np.hypot(*off.T) > stem.mean_radius(np.maximum(about[:, 2], 0.0))]
    points = np.concatenate([bark, about[about[:, 2] > 0.2]])
    return points[rng.permutation(len(points))], stem.diameters_cm(BREAST_HEIGHT_M)[0]


# ---- tables


def print_clutter(seeds: range) -> None:
    """How many heaps get a diameter; of the paper's curve also how many of those carry the flag."""
    methods = ["ring", "circle"]
    print("\n| heaps given a diameter | shrinkage | circle | Fourier, flagged |\n|---|--:|--:|--:|")
    total: Counter[str] = Counter()
    for kind in HEAPS:
        count: Counter[str] = Counter()
        for seed in seeds:
            points = make_heap(kind, seed)
            for method in methods:
                count[method] += assess_stem(points, settings=EstimatorSettings(method=method)).refusal is None
            paper = measure_stem(points, settings=MeasureSettings.paper(), curves=[])
            count["paper"] += not isinstance(paper, Refusal)
            count["flagged"] += not isinstance(paper, Refusal) and "clutter" in paper.flag_codes
        total += count
        print(f"| {kind} | {count['ring']} | {count['circle']} | {count['paper']}, {count['flagged']} |", flush=True)
    of = len(HEAPS) * len(seeds)
    print(f"| all, of {of} | {total['ring']} | {total['circle']} | {total['paper']}, {total['flagged']} |")


def print_sections(seeds: range) -> None:
    """What becomes of sections with several stems."""
    print(
        "\n| several stems | the one meant | another | none of them | refused | recognised |\n|---|--:|--:|--:|--:|--:|"
    )
    for kind in SECTIONS:
        count: Counter[str] = Counter()
        for seed in seeds:
            count.update(_verdict(make_section(kind, seed)))
        cells = " | ".join(str(count[word]) for word in ("meant", "other", "none", "refused", "recognised"))
        print(f"| {kind}, of {len(seeds)} | {cells} |", flush=True)


def _verdict(section: Section) -> list[str]:
    found = assess_stem(section.points_m)
    if found.refusal is not None:
        return ["refused", *(["recognised"] if found.refusal.code == "two_rings" else [])]
    result = found.result
    assert result is not None
    words = ["recognised"] if len(result.rings) > 1 else []
    apart = np.hypot(*(section.centres_m - result.position_m[:2]).T) / (0.005 * section.tape_cm)
    nearest = int(apart.argmin())
    if abs(result.dbh_cm / section.tape_cm[nearest] - 1.0) > _RIGHT:
        return [*words, "none"]
    return [*words, "meant" if nearest == int(section.n_points.argmax()) else "other"]


def print_stems(seeds: range) -> None:
    """Stems refused, or warned of, for what else would be in their section."""
    print("\n| stems, % | refused as clutter | refused as two | flagged as clutter | flagged: another stem |")
    print("|---|--:|--:|--:|--:|")
    for name in [*SCENARIOS, "in ferns"]:
        count: Counter[str] = Counter()
        for seed in seeds:
            points = make_ferns(seed)[0] if name == "in ferns" else make_case(name, seed).points_m
            found = assess_stem(points)
            code = "" if found.refusal is None else found.refusal.code
            count.update([f"refused {code}"])
            if found.result is not None and not code:
                count.update({flag.code for flag in found.result.flags})
        cells = [count["refused clutter"] + count["refused no_ring"], count["refused two_rings"], count["clutter"]]
        cells.append(count["neighbour"] + count["fork"])
        print(f"| {name} | " + " | ".join(f"{100 * cell / len(seeds):.0f}" for cell in cells) + " |", flush=True)


# ---- calibration


def calibrate(seeds: range) -> None:
    """Logistic regression of "no stem" on the terms; both kinds weigh alike, the noisiest stems more than others."""
    rng = np.random.default_rng(seeds[0])
    terms, is_heap, weight = [], [], []
    for name, points in _examples(seeds, rng):
        signs = _signs(points)
        if signs is not None:
            terms.append(signs.terms)
            is_heap.append(name in HEAPS)
            weight.append(_WEIGHTS.get(name, 1.0))
    x, y, w = np.array(terms), np.array(is_heap, float), np.array(weight)
    w[y == 1] *= w[y == 0].sum() / w[y == 1].sum()
    mean, sd = x.mean(axis=0), x.std(axis=0)
    z = np.column_stack([np.ones(len(x)), (x - mean) / sd])
    found_b = np.zeros(z.shape[1])
    ridge = 1e-3 * len(y) * np.array([1e-6, *np.ones(len(found_b) - 1)])
    for _ in range(60):
        p = 1.0 / (1.0 + np.exp(-np.clip(z @ found_b, -30, 30)))
        step = z.T @ (w * (p - y)) + ridge * found_b * (np.arange(len(found_b)) > 0)
        found_b = found_b - np.linalg.solve((z * (w * p * (1 - p))[:, None]).T @ z + np.diag(ridge), step)
    slopes = found_b[1:] / sd
    start = float(found_b[0] - slopes @ mean)
    print("start", round(start, 1), "slopes", [float(f"{slope:.3g}") for slope in slopes])
    print("usual", np.round(np.median(x[y == 0], axis=0), 2).tolist())
    score = start + x @ slopes
    for share in (0.99, 0.993, 0.996, 0.998):
        limit = float(np.quantile(score[y == 0], share))
        left = float((score[y == 1] <= limit).mean())
        print(
            f"{100 * share:.1f} % of stems below chance {1 / (1 + np.exp(-limit)):.2f}, and {100 * left:.0f} % of heaps"
        )


def _signs(points: np.ndarray) -> HeapSigns | None:
    """As the estimator comes by them."""
    settings = EstimatorSettings()
    points = points[in_stretch(points)]
    if len(points) < settings.min_points:
        return None
    local = points[sample_points(points, settings.max_points, seed=0)]
    local = local - [*np.median(local[:, :2], axis=0), BREAST_HEIGHT_M]
    search = search_rings(local, widest_m=1.25, taper=settings.taper, rng=np.random.default_rng([0, 201]))
    if not len(search.rings.radius):
        return None
    stems = stems_of(local, first_of(search), widest_m=1.25, seed=0)
    curve = fit_tube(stems.points, stems.main, StemPrior.from_settings(settings))
    return None if curve is None else signs_of(stems.points, curve)


_WEIGHTS = {"full, noisy": 3.0, "partial, noisy": 2.0, "lidar": 2.0, "giant": 3.0, "swollen": 3.0}
_GIANT = Scenario(arc_deg=(160, 360), dbh_cm=(90, 230), irregularity=(0.5, 2.0), points=(1000, 12000))


def _examples(seeds: range, rng: Rng) -> Iterator[tuple[str, np.ndarray]]:
    """Stems and heaps with their kinds, whole and as little as may be left of them."""
    kinds: dict[str, Callable[[int], np.ndarray]] = {
        **{name: lambda seed, name=name: make_case(name, seed).points_m for name in SCENARIOS},
        "ferns": lambda seed: make_ferns(seed)[0],
        "giant": lambda seed: _giant(seed),
        "swollen": lambda seed: _swollen(make_case("arc 240", seed).points_m, rng),
        **{kind: lambda seed, kind=kind: make_heap(kind, seed) for kind in HEAPS},
    }
    for name, make in kinds.items():
        for seed in seeds:
            points = make(seed)
            yield name, points
            yield name, _some_of(points, rng)


def _giant(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    stem = stem_of(replace(_GIANT, buttress=bool(seed % 2)), seed, rng)
    n_points = int(np.exp(rng.uniform(*np.log(_GIANT.points))))
    parts = [seen_of(_GIANT, stem, n_points, float(rng.uniform(*_GIANT.arc_deg)), rng)]
    return np.concatenate(parts + clutter_about(stem, n_points // 10, rng))


def _swollen(points: np.ndarray, rng: Rng) -> np.ndarray:
    """A whorl, a canker or a graft near breast height."""
    height, half, size = rng.uniform(1.0, 1.7), rng.uniform(0.06, 0.3), rng.uniform(0.03, 0.28)
    swelling = np.exp(-(((points[:, 2] - height) / half) ** 2))
    middle = np.median(points[np.abs(points[:, 2] - 1.3) < 0.1, :2], axis=0)
    swollen = points.copy()
    swollen[:, :2] = middle + (points[:, :2] - middle) * (1.0 + size * swelling)[:, None]
    return swollen


def _some_of(points: np.ndarray, rng: Rng) -> np.ndarray:
    """A shorter piece, thinner above or below, of fewer points."""
    if rng.random() < 0.6:
        low, high = 1.3 - rng.uniform(0.12, 0.6), 1.3 + rng.uniform(0.12, 0.7)
        points = points[(points[:, 2] > low) & (points[:, 2] < high)]
    if rng.random() < 0.5:
        share = np.clip(1.0 + rng.uniform(-2.0, 2.0) * (points[:, 2] - 1.3), 0.02, 2.5) / 2.5
        points = points[rng.random(len(points)) < share]
    if rng.random() < 0.4 and len(points) > 100:
        points = points[rng.permutation(len(points))[: int(np.exp(rng.uniform(np.log(60), np.log(len(points)))))]]
    return points


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-n", type=int, default=40, help="of each kind")
    parser.add_argument("--first", type=int, default=6000, help="first seed")
    parser.add_argument("--calibrate", action="store_true")
    options = parser.parse_args()
    seeds = range(options.first, options.first + options.n)
    if options.calibrate:
        calibrate(seeds)
        return
    print_clutter(seeds)
    print_sections(seeds)
    print_stems(seeds)


if __name__ == "__main__":
    main()
