"""How long measuring takes: 300 stems as the studio measures a plot, and one stem on one core.

    OPENBLAS_NUM_THREADS=1 python bench/measuring_speed.py [-n 300] [--first 5000] [--points 50000]

The stems are those of the laboratory, every scenario in turn but the arc of 70 degrees, which is refused early. With
`--points` all of them are as dense as that, as a trunk of a cloud of 20 million points is.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

import numpy as np
from estimator_stems import SCENARIOS, make_case

from dbh_studio.app.pipeline import measure_stems
from dbh_studio.core.ground import PlaneGround
from dbh_studio.core.protocols import StemSetup
from dbh_studio.settings import MeasureSettings

SETUP, GROUND = StemSetup(MeasureSettings()), PlaneGround(np.zeros(3))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("-n", type=int, default=300, help="stems")
    parser.add_argument("--first", type=int, default=5000, help="the first seed")
    parser.add_argument("--points", type=float, help="of each stem; as its scenario says without")
    options = parser.parse_args()
    if options.points:
        dense = {name: replace(each, points=(options.points, options.points)) for name, each in SCENARIOS.items()}
        SCENARIOS.update(dense)
    scenarios = [name for name in SCENARIOS if name != "arc 70"]
    stems = [
        (i, make_case(scenarios[i % len(scenarios)], options.first + i).points_m.astype(np.float32), SETUP)
        for i in range(options.n)
    ]
    measure_stems(stems[:5], GROUND)
    start = time.perf_counter()
    measure_stems(stems, GROUND)
    seconds = time.perf_counter() - start
    each = []
    for stem in stems[:100]:
        begun = time.thread_time()
        measure_stems([stem], GROUND)
        each.append(1000 * (time.thread_time() - begun))
    size = np.mean([len(points) for _, points, _ in stems])
    print(f"{options.n} stems of {size:,.0f} points on average: {seconds:.1f} s")
    high = np.quantile(each, 0.95)
    print(f"one stem, one core: median {np.median(each):.1f} ms, 95 % {high:.1f}, mean {np.mean(each):.1f}")


if __name__ == "__main__":
    main()
