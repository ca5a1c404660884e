"""What all tests share: hypothesis profiles, folders of their own, and the browser's path."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest
from hypothesis import HealthCheck, settings
from tests.photoplot import PhotoPlot, write_photo_plot

from dbh_studio.app.doctor import find_chromium

# No deadline: a loaded machine must not fail a test. In CI the examples are the same each time.
settings.register_profile("default", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("ci", settings.get_profile("default"), derandomize=True, print_blob=True)
settings.load_profile("ci" if os.environ.get("CI") else "default")


@pytest.fixture(scope="session", autouse=True)
def user_folders(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """No test reads or writes the cache and the settings of the person who runs it."""
    with pytest.MonkeyPatch.context() as patch:
        for name in ("XDG_CACHE_HOME", "XDG_CONFIG_HOME", "XDG_DATA_HOME", "XDG_STATE_HOME"):
            patch.setenv(name, str(tmp_path_factory.mktemp(name.lower())))
        yield


@pytest.fixture(scope="session")
def chromium_path() -> str:
    """The browser's path. Without a browser the test is skipped, but in CI, where set-up installs one, it fails."""
    path = find_chromium()
    if path is None:
        message = "No Chromium was found; 'make test' installs it, or says how."
        if os.environ.get("CI"):
            pytest.fail(message)
        pytest.skip(message)
    return path


@pytest.fixture(scope="session")
def photo_plot(tmp_path_factory: pytest.TempPathFactory) -> PhotoPlot:
    """A plot with rendered panoramas and markers; tests must not write into its folder."""
    return write_photo_plot(tmp_path_factory.mktemp("photo_plot"))
