"""The doctor: told of broken packages made on the spot, it says what is wrong and which line mends it."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from dbh_studio.app import doctor
from dbh_studio.app.components import APT_PACKAGES, COMPONENTS, Component, no_wheel_reason
from dbh_studio.app.doctor import Check

SOURCE = Path(doctor.__file__).parents[2]


@pytest.fixture
def module_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder whose modules this process and the doctor's processes can import."""
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.syspath_prepend(str(tmp_path))
    return tmp_path


def checked(folder: Path, name: str, body: str, **options: object) -> Check:
    (folder / f"{name}.py").write_text(body, encoding="utf-8")
    return doctor.check_component(Component(name, (name,), "Something is lost.", **options))  # type: ignore[arg-type]


def test_a_package_that_can_be_imported_is_ok_and_has_a_version() -> None:
    check = doctor.check_component(COMPONENTS[0])
    assert (check.name, check.status, check.remedy) == ("numpy", "ok", "")
    assert check.version.split(".")[0].isdigit()


def test_an_absent_package_is_missing_and_the_remedy_installs_it() -> None:
    check = doctor.check_component(Component("no_such_module_here", ("no-such-module-here",), "Much is lost.", True))
    assert (check.status, check.version, check.cost) == ("missing", "", "Much is lost.")
    assert check.remedy.endswith("-m pip install no-such-module-here")
    assert not doctor.is_usable([check])


def test_the_remedy_asks_for_a_version_the_studio_accepts() -> None:
    assert "'viser==1.1.1'" in doctor.pip_line("viser") or "viser==1.1.1" in doctor.pip_line("viser")
    assert "'numpy>=1.26'" in doctor.pip_line("numpy")


def test_a_missing_system_library_is_named_with_its_debian_package(
    module_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(doctor.shutil, "which", lambda name: f"/usr/bin/{name}")
    monkeypatch.setattr(doctor, "is_root", lambda: False)
    body = "raise ImportError('libusb-1.0.so.0: cannot open shared object file: No such file or directory')"
    check = checked(module_folder, "needs_usb", body)
    assert (check.status, check.apt) == ("broken", ("libusb-1.0-0",))
    assert check.detail.startswith("libusb-1.0.so.0")
    expected = "sudo apt-get update && sudo apt-get install -y --no-install-recommends libusb-1.0-0"
    assert check.remedy == expected


def test_all_libraries_that_cannot_be_loaded_are_named_at_once(
    module_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(APT_PACKAGES, "libno-such-a.so.1", "package-a")
    monkeypatch.setitem(APT_PACKAGES, "libno-such-b.so.2", "package-b")
    body = "raise ImportError('libno-such-a.so.1: cannot open shared object file: No such file or directory')"
    check = checked(module_folder, "needs_two", body, libraries=("libno-such-a.so.1", "libno-such-b.so.2"))
    assert check.apt == ("package-a", "package-b")


def test_without_apt_the_libraries_are_named_for_another_package_manager(
    module_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(doctor.shutil, "which", lambda name: None)
    body = "raise ImportError('libusb-1.0.so.0: cannot open shared object file: No such file or directory')"
    remedy = checked(module_folder, "needs_usb_elsewhere", body).remedy
    assert "libusb-1.0.so.0" in remedy and "apt-get" not in remedy


def test_an_unknown_library_is_named_with_the_way_to_find_its_package(module_folder: Path) -> None:
    body = "raise ImportError('libqqq.so.7: cannot open shared object file: No such file or directory')"
    check = checked(module_folder, "needs_unknown", body)
    assert check.apt == () and "apt-file search libqqq.so.7" in check.remedy


def test_a_package_whose_own_dependency_is_absent_names_that_one(module_folder: Path) -> None:
    check = checked(module_folder, "needs_other", "import absent_dependency.part")
    assert check.status == "broken"
    assert check.remedy.endswith("pip install absent_dependency")


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no signals to end a process with")
def test_a_package_that_crashes_is_reported_and_the_doctor_goes_on(module_folder: Path) -> None:
    check = checked(module_folder, "crashes", "import os, signal; os.kill(os.getpid(), signal.SIGKILL)")
    assert check.status == "broken" and "SIGKILL" in check.detail
    assert "--force-reinstall" in check.remedy


def test_of_packages_imported_together_the_bad_ones_are_not_named_good(module_folder: Path) -> None:
    bodies = {
        "fine": "print('imported liar', end='')",
        "raises": "raise ImportError('no')",
        "leaves": "import sys; sys.exit(3)",
        "also_fine": "",
        "dies": "import os; os._exit(139)",
        "after": "",
    }
    for name, body in bodies.items():
        (module_folder / f"{name}.py").write_text(body, encoding="utf-8")
    assert doctor.import_together(list(bodies)) & set(bodies) == {"fine", "also_fine"}
    assert doctor.import_together([]) == set()


def test_what_could_not_be_imported_together_is_tried_alone(
    module_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, body in {"dies": "import os; os._exit(7)", "after": ""}.items():
        (module_folder / f"{name}.py").write_text(body, encoding="utf-8")
    monkeypatch.setattr(doctor, "COMPONENTS", tuple(Component(name, (name,), "cost") for name in ("dies", "after")))
    monkeypatch.setattr(doctor, "check_test_parts", lambda: ())
    checks = {check.name: check for check in doctor.check_all(port=0)}
    assert (checks["dies"].status, checks["after"].status) == ("broken", "ok")
    assert "code 7" in checks["dies"].detail


def test_packages_that_hang_together_are_not_waited_for(module_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "TOGETHER_TIMEOUT_S", 1.0)
    (module_folder / "hangs.py").write_text("import time; time.sleep(60)", encoding="utf-8")
    assert doctor.import_together(["hangs"]) == set()


def test_an_import_that_hangs_is_given_up(module_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "IMPORT_TIMEOUT_S", 1.0)
    check = checked(module_folder, "hangs", "import time; time.sleep(60)")
    assert check.status == "broken" and "longer than 1 s" in check.detail


def test_what_a_package_prints_on_import_does_not_confuse_the_doctor(module_folder: Path) -> None:
    assert checked(module_folder, "chatty", "print('hello'); print('{}', end='')").status == "ok"


def test_a_package_without_a_wheel_for_this_platform_is_not_offered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dbh_studio.app.components.platform_key", lambda: "linux-aarch64")
    component = Component("no_such_module_here", ("thing",), "cost", no_wheel_on=("linux-aarch64",))
    remedy = doctor.check_component(component).remedy
    assert "linux-aarch64" in remedy and "pip" not in remedy


@pytest.mark.parametrize(("glibc", "is_too_old"), [("2.31", True), ("2.35", False), ("2.36", False)])
def test_open3d_is_not_offered_on_an_old_c_library(
    monkeypatch: pytest.MonkeyPatch, glibc: str, is_too_old: bool
) -> None:
    monkeypatch.setattr("dbh_studio.app.components.platform.libc_ver", lambda: ("glibc", glibc))
    monkeypatch.setattr("dbh_studio.app.components.platform_key", lambda: "linux-x86_64")
    open3d = next(component for component in COMPONENTS if component.module == "open3d")
    assert ("2.35" in no_wheel_reason(open3d)) is is_too_old


@pytest.mark.parametrize(
    ("version", "status"), [((3, 9), "broken"), ((3, 10), "ok"), ((3, 13), "ok"), ((3, 14), "broken")]
)
def test_python_versions(monkeypatch: pytest.MonkeyPatch, version: tuple[int, int], status: str) -> None:
    monkeypatch.setattr(doctor.sys, "version_info", (*version, 0, "final", 0))
    check = doctor.check_python()
    assert check.status == status and check.required
    assert bool(check.remedy) is (status != "ok")


def test_a_port_in_use_is_said_and_another_is_offered() -> None:
    with socket.socket() as server:
        server.bind(("127.0.0.1", 0))
        server.listen()
        port = server.getsockname()[1]
        check = doctor.check_port(port)
    assert check.status == "broken" and f"--port {port + 1}" in check.remedy
    assert doctor.check_port(port).status == "ok"


def test_a_full_disk_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    usage = doctor.shutil._ntuple_diskusage(10**12, 10**12 - 10**9, 10**9)
    monkeypatch.setattr(doctor.shutil, "disk_usage", lambda folder: usage)
    check = doctor.check_disk(tmp_path / "not" / "yet" / "there")
    assert (check.status, check.version) == ("missing", "1.0 GB free")


def test_a_folder_that_may_not_be_written_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor.os, "access", lambda folder, mode: False)  # To root, every folder can be written.
    check = doctor.check_disk(tmp_path / "cache")
    assert check.status == "broken" and str(tmp_path) in check.remedy


def test_the_disk_looked_at_is_that_of_the_cache_in_use(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "cache").write_bytes(b"")
    monkeypatch.setenv("DBH_STUDIO_CACHE", str(tmp_path / "cache" / "deeper"))
    check = doctor.check_disk()
    assert check.status == "broken" and str(tmp_path / "cache") in check.detail


def test_a_cache_below_a_folder_that_may_not_be_looked_into(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def denied(path: Path, **_: object) -> object:
        raise PermissionError

    monkeypatch.setattr(Path, "stat", denied)  # To root, every folder can be looked into.
    monkeypatch.setattr(Path, "is_dir", lambda path: True)
    assert doctor.check_disk(tmp_path / "closed" / "cache").status == "ok"


def test_a_file_where_the_cache_should_be_is_said(tmp_path: Path) -> None:
    (tmp_path / "cache").write_bytes(b"")
    assert doctor.check_disk(tmp_path / "cache").status == "broken"


def test_little_memory_and_one_core_are_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "_memory_gb", lambda: 2.0)
    monkeypatch.setattr(doctor.os, "sched_getaffinity", lambda pid: {0}, raising=False)
    checks = (doctor.check_memory(), doctor.check_cores())
    assert [check.status for check in checks] == ["missing", "missing"]
    assert doctor.is_usable(checks)


def test_a_browser_that_does_not_start_is_broken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fake = tmp_path / "chromium"
    fake.write_text("#!/bin/sh\necho 'install the snap first' >&2\nexit 1\n", encoding="utf-8")
    fake.chmod(0o755)
    monkeypatch.setattr(doctor, "find_chromium", lambda: str(fake))
    check = doctor.check_chromium()
    assert (check.status, check.detail, check.apt) == ("broken", "install the snap first", ("chromium",))


def test_the_library_that_the_browser_driver_lacks_is_named(module_folder: Path) -> None:
    error = "driver/node: error while loading shared libraries: libatomic.so.1: cannot open shared object file: No such"
    (module_folder / "playwright.py").write_text(f"import sys; sys.exit({error!r})", encoding="utf-8")
    check = doctor.check_playwright()
    assert (check.status, check.apt, check.is_for_tests) == ("broken", ("libatomic1",), True)


def test_the_studio_is_usable_without_optional_parts_and_not_without_required_ones() -> None:
    fine = Check("a", "ok", "1", "cost", "", True)
    optional = Check("b", "missing", "", "cost", "line", False)
    required = Check("c", "broken", "1", "cost", "line", True)
    assert doctor.is_usable([fine, optional])
    assert not doctor.is_usable([fine, required])


def test_the_report_says_the_cost_and_the_line_of_what_is_not_ok_only() -> None:
    checks = [
        Check("good", "ok", "1.2", "cost of good", "", True),
        Check("bad", "broken", "3", "cost of bad", "mend bad", False, "why it is bad", ("libx",)),
        Check("gone", "missing", "", "cost of gone", "mend gone", False, apt=("liby",)),
    ]
    report = doctor.format_report(checks)
    for text in ("good", "1.2", "cost of bad", "mend bad", "why it is bad", "cost of gone", "mend gone"):
        assert text in report
    assert "cost of good" not in report
    assert "--no-install-recommends libx liby" in report
    assert report.endswith("The studio works; without the full use of bad, gone.")


def test_what_only_the_tests_use_is_no_loss_to_the_forester() -> None:
    checks = [Check("browser", "missing", "", "cost", "line", False, apt=("a", "b"), is_for_tests=True)]
    assert doctor.format_report(checks).endswith("The studio works. Its own browser tests lack browser.")
    assert "in one line" not in doctor.format_report(checks)


def test_the_json_report_can_be_read_by_programs() -> None:
    check = Check("bad", "broken", "3", "cost", "mend", True, apt=("libx",))
    report = json.loads(doctor.format_json([check]))
    assert report["usable"] is False and report["apt_packages"] == ["libx"]
    assert report["checks"][0]["status"] == "broken" and report["checks"][0]["required"] is True


def test_the_doctor_works_where_no_package_is_installed() -> None:
    """-S leaves site-packages out, -I the environment: only the standard library and the studio's source are there."""
    code = (
        f"import sys; sys.path.insert(0, {str(SOURCE)!r}); from dbh_studio.app import doctor; doctor.main(['--json'])"
    )
    done = subprocess.run(
        [sys.executable, "-I", "-S", "-c", code], capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    status = {check["name"]: check["status"] for check in report["checks"]}
    assert report["usable"] is False
    assert status["Python"] == "ok" and status["numpy"] == "missing" and status["viser"] == "missing"


def test_here_nothing_required_is_missing() -> None:
    checks = doctor.check_all(port=0)
    assert doctor.is_usable(checks), doctor.format_report(checks)
    assert len({check.name for check in checks}) == len(checks)


def test_the_exit_code_says_whether_the_studio_works(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for status, code in (("ok", 0), ("missing", 1)):
        monkeypatch.setattr(doctor, "check_all", lambda status=status: (Check("it", status, "", "c", "r", True),))
        assert doctor.main([]) == code
        assert "The studio" in capsys.readouterr().out


def test_set_up_is_given_the_names_of_the_packages_to_install(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(
        doctor, "check_component", lambda item: Check("x", "broken", "", "c", "r", False, apt=("libz",))
    )
    monkeypatch.setattr(
        doctor, "check_test_parts", lambda: (Check("y", "missing", "", "c", "r", False, apt=("brow",)),)
    )
    assert doctor.main(["--apt-packages", "run"]) == 0
    assert capsys.readouterr().out == "libz\n"
    assert doctor.main(["--apt-packages", "test"]) == 0
    assert capsys.readouterr().out == "brow\nlibz\n"
