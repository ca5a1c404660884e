"""Everything that is computed from a Document, remembered by the identity of what it was computed from.

There are no dirty flags: a changed trunk is another object, so it is looked up and not found. After one edit among 300
trunks one is measured; after Undo none is, because the old trunk is the same object again.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import TYPE_CHECKING, Any, Generic, TypeVar, get_args
from weakref import WeakKeyDictionary

import numpy as np

from dbh_studio.app.document import Document
from dbh_studio.app.threads import map_in_threads
from dbh_studio.core.arrays import Float32, readonly
from dbh_studio.core.cloud import PointCloud
from dbh_studio.core.inventory import Inventory, InventoryRow, MapPosition, inventory_row
from dbh_studio.core.progress import Progress, ignore_progress
from dbh_studio.core.protocols import StemSetup, setup_key, stem_setup
from dbh_studio.core.transforms import Similarity
from dbh_studio.core.trunks import Trunk
from dbh_studio.settings import CurveName

if TYPE_CHECKING:
    from dbh_studio.core.ground import GroundModel
    from dbh_studio.core.stem_profile import ProfilePoint
    from dbh_studio.stages.measure import StemMeasurement

Value = TypeVar("Value")

UNSCALED_REASON = "The cloud has no scale, so its lengths are in an arbitrary unit."
UNSCALED_REMEDY = "Set the scale: by a marker of known size, a length measured in the field, or the unit of the file."

_CHUNK = 2_000_000
_N_GROUNDS = 8
# Per trunk: enough to undo a row of changed settings without measuring again.
_N_MEASUREMENTS = 8


class _Recent(Generic[Value]):
    """The few values used last, by key."""

    def __init__(self, size: int) -> None:
        self._size = size
        self._values: OrderedDict[Hashable, Value] = OrderedDict()

    def get(self, key: Hashable) -> Value | None:
        if key in self._values:
            self._values.move_to_end(key)
        return self._values.get(key)

    def put(self, key: Hashable, value: Value) -> Value:
        self._values[key] = value
        self._values.move_to_end(key)
        while len(self._values) > self._size:
            self._values.popitem(last=False)
        return value


def transformed(cloud: PointCloud, world_from_source: Similarity) -> Float32:
    """(N, 3) float32 points in the world frame; the cloud's own memory where nothing changes."""
    is_unscaled = world_from_source.scale == 1 and not world_from_source.translation.any()
    if is_unscaled and np.array_equal(world_from_source.rotation, np.eye(3)):
        return cloud.xyz
    points = np.empty(cloud.xyz.shape, np.float32)
    linear = world_from_source.scale * world_from_source.rotation
    if (np.count_nonzero(linear, axis=1) == 1).all():
        # The six axes: columns change places, which takes a tenth of the time of a product and rounds only once.
        for row, column in enumerate(np.abs(linear).argmax(axis=1)):
            np.multiply(cloud.xyz[:, column], np.float32(linear[row, column]), out=points[:, row])
        points += world_from_source.translation.astype(np.float32)
        return readonly(points)
    for start in range(0, len(points), _CHUNK):
        part = slice(start, start + _CHUNK)
        points[part] = world_from_source.apply(cloud.xyz[part])
    return readonly(points)


def _frame_key(document: Document) -> Hashable:
    scale = document.scale
    metres_per_unit = scale.metres_per_unit if scale.is_known else 1.0
    return document.up_direction, document.north_direction, document.origin_src, metres_per_unit


def _ground_key(document: Document) -> Hashable:
    return _frame_key(document), document.settings.ground


def _measure_key(document: Document, trunk_id: int) -> Hashable:
    corrections = document.record(trunk_id).corrections
    return _ground_key(document), setup_key(corrections, document.settings.measure), document.scale.relative_sd


def stem_setup_of(document: Document, trunk_id: int) -> StemSetup:
    """How a stem of a plot is measured: as the plot, and as was said of this stem.

    Raises:
        KeyError: There is no such trunk.
    """
    return stem_setup(
        document.record(trunk_id).corrections,
        document.settings.measure,
        points=document.trunks[trunk_id].points,
        world_from_source=document.world_from_source,
    )


class Derived:
    """Derived values of the Documents of one cloud.

    May be asked from several threads: the points and the ground are computed once, a stem at worst twice.

    Args:
        cloud: The plot's points.
        fit_ground: For tests; `core.ground.fit_ground` by default.
        measure_trunk: For tests; `stages.measure.measure_trunk` by default.
    """

    def __init__(
        self,
        cloud: PointCloud,
        *,
        fit_ground: Callable[..., GroundModel] | None = None,
        measure_trunk: Callable[..., StemMeasurement] | None = None,
    ) -> None:
        self._cloud = cloud
        self._fit_ground = fit_ground
        self._measure_trunk = measure_trunk
        self._lock = threading.RLock()
        self._points: _Recent[Float32] = _Recent(1)
        self._grounds: _Recent[GroundModel] = _Recent(_N_GROUNDS)
        self._under_way: dict[tuple[object, Hashable], threading.Event] = {}
        self._stems: WeakKeyDictionary[Trunk, _Recent[StemMeasurement]] = WeakKeyDictionary()
        self._inventory: tuple[Document, Inventory] | None = None
        self._map_system: tuple[bool, int | None] | None = None

    def points_world(self, document: Document) -> Float32:
        """(N, 3) float32 points of the cloud in the world frame, read-only."""
        return self._once(
            self._points, _frame_key(document), lambda: transformed(self._cloud, document.world_from_source)
        )

    def ground(self, document: Document, progress: Progress = ignore_progress) -> GroundModel:
        """The ground under the stems."""

        def fit() -> GroundModel:
            fit_ground = self._fit_ground or _default_fit_ground()
            return fit_ground(self.points_world(document), settings=document.settings.ground, progress=progress)

        return self._once(self._grounds, _ground_key(document), fit)

    def _once(self, recent: _Recent[Value], key: Hashable, compute: Callable[[], Value]) -> Value:
        """The value of `key`; where several threads ask, one computes, without the lock, and the others wait for it.

        Where that one fails or is cancelled, another computes.
        """
        while True:
            with self._lock:
                value = recent.get(key)
                if value is not None:
                    return value
                under_way = self._under_way.get((recent, key))
                if under_way is None:
                    done = self._under_way[recent, key] = threading.Event()
                    break
            under_way.wait()
        try:
            value = compute()
            with self._lock:
                return recent.put(key, value)
        finally:
            with self._lock:
                del self._under_way[recent, key]
            done.set()

    def has_ground(self, document: Document) -> bool:
        """Whether `ground` answers at once."""
        with self._lock:
            return self._grounds.get(_ground_key(document)) is not None

    def put_ground(self, document: Document, ground: GroundModel) -> None:
        """Remember a ground that a job fitted to the points and ground settings of `document`."""
        with self._lock:
            self._grounds.put(_ground_key(document), ground)

    def known_measurement(self, document: Document, trunk_id: int) -> StemMeasurement | None:
        """The measurement of a stem if it is there already."""
        with self._lock:
            recent = self._stems.get(document.trunks[trunk_id])
            return recent.get(_measure_key(document, trunk_id)) if recent is not None else None

    def put_measurement(self, document: Document, measurement: StemMeasurement) -> StemMeasurement:
        """Remember a stem that was measured with the ground and settings of `document`."""
        with self._lock:
            recent = self._stems.setdefault(document.trunks[measurement.trunk_id], _Recent(_N_MEASUREMENTS))
            return recent.put(_measure_key(document, measurement.trunk_id), measurement)

    def measurement(self, document: Document, trunk_id: int) -> StemMeasurement:
        """The diameter of one stem, or why there is none.

        Raises:
            KeyError: There is no such trunk.
        """
        trunk = document.trunks[trunk_id]
        if not document.scale.is_known:
            return _unscaled(trunk)
        known = self.known_measurement(document, trunk_id)
        if known is not None:
            return known
        return self.put_measurement(document, self._measured(document, trunk))

    def compared(self, document: Document, trunk_id: int) -> StemMeasurement:
        """The diameter of one stem with every method's curve beside it; measured anew.

        Raises:
            KeyError: There is no such trunk.
        """
        trunk = document.trunks[trunk_id]
        if not document.scale.is_known:
            return _unscaled(trunk)
        return self._measured(document, trunk, curves=get_args(CurveName))

    def _measured(self, document: Document, trunk: Trunk, **options: Any) -> StemMeasurement:
        measure_trunk = self._measure_trunk or _default_measure_trunk()
        setup = stem_setup_of(document, trunk.id)
        return measure_trunk(
            setup.measured(self.points_world(document)[trunk.points]),
            trunk_id=trunk.id,
            ground=self.ground(document),
            settings=setup.settings,
            scale_sd=document.scale.relative_sd,
            **setup.placed,
            **options,
        )

    def profile(self, document: Document, trunk_id: int) -> tuple[ProfilePoint, ...]:
        """Diameters along one stem; none where the cloud has no scale or the stem no ground.

        Raises:
            KeyError: There is no such trunk.
        """
        z_ground_m = self.measurement(document, trunk_id).z_ground_m
        if not np.isfinite(z_ground_m):
            return ()
        from dbh_studio.stages.measure import profile_trunk

        setup = stem_setup_of(document, trunk_id)
        return profile_trunk(
            setup.measured(self.points_world(document)[document.trunks[trunk_id].points]),
            z_ground_m=z_ground_m,
            settings=setup.settings,
            scale_sd=document.scale.relative_sd,
        )

    def measurements(self, document: Document, progress: Progress = ignore_progress) -> tuple[StemMeasurement, ...]:
        """All stems, in order of id."""
        ids = document.trunks.ids
        missing = [i for i in ids if self.known_measurement(document, i) is None] if document.scale.is_known else []
        progress(0.0, "Measuring the stems")
        size = sum(len(document.trunks[i]) for i in missing) / max(len(missing), 1)
        measured = map_in_threads(lambda i: self.measurement(document, i), missing, size=size)
        for n_done, _ in enumerate(measured, start=1):
            progress(n_done / len(missing), f"Measured {n_done} of {len(missing)} stems")
        progress(1.0, "")
        return tuple(self.measurement(document, i) for i in ids)

    def inventory(self, document: Document, progress: Progress = ignore_progress) -> Inventory:
        """One row per stem."""
        with self._lock:
            if self._inventory is not None and self._inventory[0] is document:
                return self._inventory[1]
        stems = self.measurements(document, progress)
        own = {i: record.fields for i, record in document.trees.items()}
        inventory = Inventory.of((self._row(document, stem) for stem in stems), own)
        with self._lock:
            self._inventory = document, inventory
        return inventory

    def _row(self, document: Document, stem: StemMeasurement) -> InventoryRow:
        trunk = document.trunks[stem.trunk_id]
        return inventory_row(
            stem.result,
            plot_id=document.plot_id,
            stem_id=trunk.id,
            record=document.record(trunk.id),
            xy_m=stem.xy_m,
            z_ground_m=stem.z_ground_m,
            scale=document.scale,
            edited=trunk.origin == "hand",
            position=self._position(document, stem),
            protocol=stem.protocol,
        )

    def _position(self, document: Document, stem: StemMeasurement) -> MapPosition | None:
        """In the cloud's reference system, while the source's x and y are its easting and northing."""
        if self._map_system is None:
            from dbh_studio.io.inventory_csv import projected_epsg

            self._map_system = projected_epsg(self._cloud.crs)
        is_projected, epsg = self._map_system
        if not is_projected or not document.scale.is_known or document.up_direction != (0.0, 0.0, 1.0):
            return None
        point_world = np.array([[*stem.xy_m, 0.0]], np.float64)
        point_src = document.world_from_source.inverse().apply(point_world)[0] + self._cloud.origin
        return MapPosition(float(point_src[0]), float(point_src[1]), epsg)


def _default_fit_ground() -> Callable[..., GroundModel]:
    from dbh_studio.core.ground import fit_ground  # scipy is slow to import, and not needed to open a window

    return fit_ground


def _default_measure_trunk() -> Callable[..., StemMeasurement]:
    from dbh_studio.stages.measure import measure_trunk

    return measure_trunk


def _unscaled(trunk: Trunk) -> StemMeasurement:
    from dbh_studio.core.dbh import Refusal
    from dbh_studio.stages.measure import StemMeasurement

    return StemMeasurement(
        trunk_id=trunk.id,
        result=Refusal("unscaled", UNSCALED_REASON, UNSCALED_REMEDY),
        xy_m=np.full(2, np.nan),
        z_ground_m=float("nan"),
        n_points=len(trunk),
        ground_kind="stem_base",
        protocol=None,
    )
