from __future__ import annotations

import gc
import threading
import weakref

import numpy as np
import pytest
from tests.app.plots import METRES, FlatGround, make_cloud, make_document, make_session, trunk

from dbh_studio.app import commands
from dbh_studio.app.derived import Derived
from dbh_studio.core.scale import ScaleEstimate


def edited(trunk_id: int, *points: int) -> commands.Command:
    """What a brush will do: put other points in one trunk."""
    from dataclasses import replace

    def apply(document):
        return replace(document, trunks=document.trunks.with_trunk(trunk(trunk_id, *points, origin="hand")))

    return commands.Command(f"Edit trunk {trunk_id}", apply)


def test_one_edit_among_300_trunks_measures_one_and_undo_and_redo_none():
    session, stages = make_session(n_points=4000, n_trunks=300)
    session.inventory()
    assert sorted(stages.measured) == list(range(1, 301)) and stages.n_grounds == 1
    stages.measured.clear()
    session.do(edited(17, 160, 161, 3500))
    assert session.unmeasured() == (17,)
    after = session.inventory()
    assert stages.measured == [17]
    session.undo()
    before = session.inventory()
    session.redo()
    again = session.inventory()
    session.do(commands.delete_trunk(4))
    session.do(commands.rename_plot("other"))
    session.do(commands.set_tree_record(5, species="oak"))
    session.inventory()
    assert stages.measured == [17] and stages.n_grounds == 1
    assert again.rows == after.rows != before.rows
    assert after.rows[16].edited and not before.rows[16].edited


def test_every_input_of_a_measurement_is_in_its_key():
    session, stages = make_session(n_trunks=3)
    session.measurements()
    for n_grounds, command in [
        (1, commands.change_settings("measure", curve="ellipse")),
        (2, commands.change_settings("ground", cell_m=1.0)),
        (3, commands.set_scale(ScaleEstimate(2.0, "factor"))),
        (4, commands.set_up("+x")),
    ]:
        stages.measured.clear()
        session.do(command)
        session.measurements()
        assert sorted(stages.measured) == [1, 2, 3], command.label
        assert stages.n_grounds == n_grounds, command.label
    stages.measured.clear()
    while session.can_undo:
        session.undo()
        session.measurements()
    assert stages.measured == [] and stages.n_grounds == 4


def test_a_scale_of_the_same_size_from_elsewhere_measures_nothing_again():
    session, stages = make_session(n_trunks=2)
    session.do(commands.set_scale(ScaleEstimate(1.0, "bars", 0.01)))
    session.measurements()
    session.do(commands.set_scale(ScaleEstimate(1.0, "marker", 0.01)))
    stages.measured.clear()
    rows = session.inventory().rows
    assert stages.measured == []
    session.do(commands.set_scale(ScaleEstimate(1.0, "marker", 0.02)))  # which every interval has in it
    session.measurements()
    assert sorted(stages.measured) == [1, 2]  # two threads, in either order
    assert rows[0].scale_source == "marker" and rows[0].scale_err_pct == pytest.approx(1.0)


def test_points_share_memory_while_nothing_is_to_be_done_and_are_float32_otherwise():
    session, _ = make_session()
    assert np.shares_memory(session.points_world(), session.cloud.xyz)
    for up in ("+z", "-z", "+y", "-y", "+x", "-x", (0.6, 0.0, 0.8)):
        session.do(commands.set_scale(ScaleEstimate(1.5, "factor")))
        session.do(commands.set_up(up))
        points = session.points_world()
        assert points is session.points_world() and points.dtype == np.float32 and not points.flags.writeable
        exact = session.document.world_from_source.apply(session.cloud.xyz.astype(np.float64))
        assert np.allclose(points, exact, rtol=1e-6, atol=1e-5)


def test_a_jobs_results_are_used_instead_of_computing():
    session, stages = make_session(n_trunks=2)
    document = session.document
    session.remember_ground(document, FlatGround())
    assert session.has_ground()
    stem = stages.measure_trunk(
        session.points_world()[:10], trunk_id=1, ground=FlatGround(), settings=document.settings.measure
    )
    session.do(commands.rename_plot("meanwhile"))
    session.remember_measurements(document, [stem])
    stages.measured.clear()
    assert session.measurement(1) is stem
    assert session.unmeasured() == (2,)
    assert stages.measured == [] and stages.n_grounds == 0


def test_what_no_document_needs_any_more_is_forgotten():
    session, _ = make_session(n_trunks=1, history_limit=1)
    stem = weakref.ref(session.measurement(1))
    session.do(commands.delete_trunk(1))
    session.do(commands.rename_plot("a"))
    session.do(commands.rename_plot("b"))
    gc.collect()
    assert stem() is None


def test_measurements_of_one_stem_are_bounded():
    session, stages = make_session(n_trunks=1)
    for i in range(30):
        session.do(commands.change_settings("measure", seed=i))
        session.measurement(1)
    stages.measured.clear()
    for _ in range(7):
        session.undo()
        session.measurement(1)
    assert stages.measured == []
    assert len(session._derived._stems[session.document.trunks[1]]._values) <= 8


def test_map_coordinates_come_from_the_source_and_only_where_they_are_easting_and_northing():
    pytest.importorskip("pyproj")
    cloud = make_cloud(crs="EPSG:32633")
    _, stages = make_session()
    derived = Derived(cloud, fit_ground=stages.fit_ground, measure_trunk=stages.measure_trunk)
    document = make_document(cloud, n_trunks=1)
    row = derived.inventory(document).rows[0]
    mean = cloud.xyz[:10].mean(axis=0, dtype=np.float64) + cloud.origin
    assert (row.easting, row.northing) == pytest.approx((mean[0], mean[1]), abs=1e-3)
    assert row.epsg == 32633
    assert (row.x_m, row.y_m) == pytest.approx((mean - cloud.origin)[:2], abs=1e-3)
    turned = make_document(cloud, n_trunks=1, up_direction=(0.0, 1.0, 0.0))
    row = derived.inventory(turned).rows[0]
    assert row.easting is None and row.northing is None and row.epsg is None
    # A cloud in feet: metres in the world, the file's own numbers on the map.
    feet = make_document(cloud, n_trunks=1, scale=ScaleEstimate(0.3048, "feet"))
    row = derived.inventory(feet).rows[0]
    assert (row.easting, row.northing) == pytest.approx((mean[0], mean[1]), abs=1e-3)


def test_progress_can_stop_measuring():
    session, stages = make_session(n_trunks=20)

    def stop(fraction, message=""):
        if fraction >= 0.1:
            raise InterruptedError

    with pytest.raises(InterruptedError):
        session.measurements(stop)
    # Two were reported; a few more may have been under way.
    assert {1, 2} <= set(stages.measured) <= set(range(1, 7))
    assert session.document.scale == METRES


def test_while_the_ground_is_fitted_nobody_waits_who_does_not_need_it():
    cloud = make_cloud()
    document = make_document(cloud, n_trunks=2)
    begun, may_end, n_fits = threading.Event(), threading.Event(), 0

    def slow_fit(points_world, *, settings, progress):
        nonlocal n_fits
        n_fits += 1
        begun.set()
        assert may_end.wait(30)
        return FlatGround()

    derived = Derived(cloud, fit_ground=slow_fit)
    grounds = []
    threads = [threading.Thread(target=lambda: grounds.append(derived.ground(document))) for _ in range(3)]
    answers = []

    def look():
        answers.append((derived.has_ground(document), derived.known_measurement(document, 1)))

    looker = threading.Thread(target=look)
    try:
        for thread in threads:
            thread.start()
        assert begun.wait(30)
        looker.start()
        looker.join(10)
        assert answers == [(False, None)]
    finally:
        may_end.set()
        for thread in (*threads, looker):
            thread.join(30)
    assert n_fits == 1 and len(grounds) == 3 and len(set(map(id, grounds))) == 1


def test_a_fit_that_fails_is_begun_again_by_whoever_waited_for_it():
    cloud = make_cloud()
    document = make_document(cloud)
    begun, may_fail, fits = threading.Event(), threading.Event(), []

    def fit(points_world, *, settings, progress):
        fits.append(threading.current_thread().name)
        if len(fits) == 1:
            begun.set()
            assert may_fail.wait(30)
            raise InterruptedError
        return FlatGround()

    derived = Derived(cloud, fit_ground=fit)
    outcomes = {}

    def ask():
        try:
            outcomes[threading.current_thread().name] = derived.ground(document)
        except InterruptedError:
            outcomes[threading.current_thread().name] = None

    first, second = (threading.Thread(target=ask, name=name) for name in ("first", "second"))
    first.start()
    assert begun.wait(30)
    second.start()
    may_fail.set()
    first.join(30)
    second.join(30)
    assert fits == ["first", "second"]
    assert outcomes["first"] is None and isinstance(outcomes["second"], FlatGround)
