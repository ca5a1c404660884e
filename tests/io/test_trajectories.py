"""Trajectories from files: what each format means, and what is wrong with a file in words."""

from __future__ import annotations

import json

import numpy as np
import pytest

from dbh_studio.errors import EmptyFileError, FileError, FileMissingError, MalformedFileError, UnsupportedFormatError
from dbh_studio.io.trajectories import holds_photos, read_trajectory

TIMES = 1_700_000_000.0 + np.arange(12) * 0.5
PLACES = np.random.default_rng(0).uniform(-20, 20, (12, 3)).round(4)


def written(path, lines):
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def rows(form, times=TIMES, end=""):
    return [form.format(t=t, x=x, y=y, z=z) + end for t, (x, y, z) in zip(times, PLACES, strict=True)]


def check(read, file_format, *, start=TIMES[0]):
    assert read.file_format == file_format
    assert read.xyz == pytest.approx(PLACES, abs=1e-4)
    assert read.time_s is not None
    assert read.time_s - read.time_s[0] == pytest.approx(TIMES - TIMES[0], abs=1e-3)
    assert read.time_s[0] == pytest.approx(start, abs=1e-3)


def test_tum(tmp_path):
    lines = ["# timestamp tx ty tz qx qy qz qw", *rows("{t:.6f} {x} {y} {z} 0 0 0 1")]
    check(read_trajectory(written(tmp_path / "odom.txt", lines)), "table")
    check(read_trajectory(written(tmp_path / "bare.txt", lines[1:])), "tum")
    check(read_trajectory(written(tmp_path / "comma.csv", [line.replace(" ", ",") for line in lines[1:]])), "tum")


def kitti_lines():
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    return [" ".join(f"{value:.6e}" for value in np.column_stack([turn, place]).ravel()) for place in PLACES]


def test_kitti_takes_times_beside_it_or_given_or_a_rate(tmp_path):
    path = written(tmp_path / "poses.txt", kitti_lines())
    assert read_trajectory(path).time_s is None
    check(read_trajectory(path, rate_hz=2.0), "kitti", start=0.0)
    elsewhere = written(tmp_path / "clock.txt", ["time", *(f"{t:.3f}" for t in TIMES)])
    check(read_trajectory(path, times=elsewhere), "kitti")
    written(tmp_path / "times.txt", [f"{t:.3f}" for t in TIMES - TIMES[0]])
    check(read_trajectory(path), "kitti", start=0.0)


def test_twelve_numbers_that_are_no_pose_are_refused(tmp_path):
    path = written(tmp_path / "poses.txt", [" ".join(["7.5"] * 12)] * 12)
    with pytest.raises(MalformedFileError, match="no KITTI poses"):
        read_trajectory(path)


@pytest.mark.parametrize(
    ("header", "form"),
    [
        ("time,x,y,z", "{t},{x},{y},{z}"),
        ("Timestamp [s];Pos. X [m];Pos. Y [m];Pos. Z [m]", "{t};{x};{y};{z}"),
        ("name\tt\teasting\tnorthing\theight\tqw", "a\t{t}\t{x}\t{y}\t{z}\t1"),
        ("x_m,y_m,z_m,time_s", "{x},{y},{z},{t}"),
        ("%time,field.header.seq,field.pose.pose.position.x,field.pose.pose.position.y,field.pose.pose.position.z",
         "{t},7,{x},{y},{z}"),
        ("%time x y z q0 q1 q2 q3", "{t} {x} {y} {z} 1 0 0 0"),
    ],
)  # fmt: skip
def test_a_table_by_its_header(tmp_path, header, form):
    check(read_trajectory(written(tmp_path / "walk.csv", [header, *rows(form)])), "table")


@pytest.mark.parametrize(
    ("header", "factor"),
    [("time", 1e3), ("time", 1e6), ("timestamp", 1e9), ("t (ms)", 1e3), ("time_ns", 1e9), ("stamp [us]", 1e6)],
)
def test_the_unit_of_the_clock(tmp_path, header, factor):
    lines = [f"{header},x,y,z", *rows("{t:.0f},{x},{y},{z}", times=TIMES * factor)]
    check(read_trajectory(written(tmp_path / "walk.csv", lines)), "table")


def test_seconds_and_nanoseconds_in_two_columns_and_dates(tmp_path):
    lines = [f"{int(t)},{round(1e9 * (t % 1))},{x},{y},{z}" for t, (x, y, z) in zip(TIMES, PLACES, strict=True)]
    check(read_trajectory(written(tmp_path / "ros.csv", ["sec,nanosec,x,y,z", *lines])), "table")
    dates = [np.datetime64(round(1e3 * t), "ms") for t in TIMES]
    lines = [f"{date}Z,{x},{y},{z}" for date, (x, y, z) in zip(dates, PLACES, strict=True)]
    check(read_trajectory(written(tmp_path / "dates.csv", ["time,x,y,z", *lines])), "table")


def test_a_table_without_times_takes_a_rate(tmp_path):
    path = written(tmp_path / "walk.csv", ["x,y,z", *rows("{x},{y},{z}")])
    assert read_trajectory(path).time_s is None
    check(read_trajectory(path, rate_hz=2.0), "table", start=0.0)


def test_disorder_and_doubles_are_put_right_and_told(tmp_path):
    lines = rows("{t} {x} {y} {z} 0 0 0 1")
    path = written(tmp_path / "odom.txt", [*lines[::-1], lines[3], "1700000009 nan 0 0 0 0 0 1", "cut off"])
    read = read_trajectory(path)
    check(read, "tum")
    assert any("2 of 15 lines" in note for note in read.notes) and any("1 poses" in note for note in read.notes)


@pytest.mark.parametrize(
    ("lines", "error", "match"),
    [
        ([""], EmptyFileError, "empty"),
        (["# only a comment"], EmptyFileError, "no pose"),
        (["time,x,y,z"], EmptyFileError, "no pose"),
        (["time,speed,mood"], UnsupportedFormatError, "names no x, y and z"),
        (["1 2 3 4 5"] * 12, UnsupportedFormatError, "5 numbers a line"),
        (["time,x,y,z", "1,1,1,1", "a,b,c,d", "e,f,g,h"], MalformedFileError, r"2 of its 3 lines.*line 3"),
        (["5 0 0 0 0 0 0 1"] * 12, FileError, "one time"),
        (["time,x,y,z", "1,1,1,1", *[f'{k},"' + "a" * 200_000 for k in range(3)]], MalformedFileError, "3 of its 4"),
        (['"' + "a" * 200_000 + ",x"], UnsupportedFormatError, "names no x, y and z"),
        (["time,x,y,z", *[f"{k},1e300,{k}e299,1e300" for k in range(9)]], MalformedFileError, "9 of its 9"),
    ],
)
def test_what_is_wrong_is_told(tmp_path, lines, error, match):
    with pytest.raises(error, match=match) as told:
        read_trajectory(written(tmp_path / "walk.txt", lines))
    assert told.value.remedy and "walk.txt" in str(told.value)


def test_missing_files_and_times_that_do_not_fit(tmp_path):
    with pytest.raises(FileMissingError):
        read_trajectory(tmp_path / "nowhere.txt")
    path = written(tmp_path / "poses.txt", kitti_lines())
    with pytest.raises(MalformedFileError, match=r"5 times for the 12 poses"):
        read_trajectory(path, times=written(tmp_path / "few.txt", ["1", "2", "3", "4", "5"]))
    with pytest.raises(MalformedFileError, match="no list of times"):
        read_trajectory(path, times=written(tmp_path / "words.txt", ["1", "two"]))
    for odd in ("inf", "nan", "1e300"):
        with pytest.raises(MalformedFileError, match="times are no numbers"):
            read_trajectory(path, times=written(tmp_path / "odd.txt", [*"12345678901", odd]))
    with pytest.raises(ValueError, match="rate"):
        read_trajectory(path, rate_hz=0.0)


def photo_list(names, times=None):
    images = []
    for index, (name, place) in enumerate(zip(names, PLACES, strict=True)):
        image = {"name": name, "width": 100, "height": 50, "model": "EQUIRECTANGULAR", "quaternion": [1, 0, 0, 0],
                 "centre": place.tolist()}  # fmt: skip
        images.append(image if times is None else {**image, "time_s": times[index]})
    return json.dumps({"images": images})


def test_photos_with_times_and_by_the_numbers_of_their_frames(tmp_path):
    path = tmp_path / "poses.json"
    path.write_text(photo_list([f"{i}.jpg" for i in range(12)], TIMES))
    assert holds_photos(path) and holds_photos(tmp_path)
    check(read_trajectory(path), "table")
    # Every fifteenth frame of a film of 30 a second.
    path.write_text(photo_list([f"film_{15 * i:06d}.jpg" for i in range(12)]))
    assert read_trajectory(path).time_s is None
    check(read_trajectory(path, rate_hz=30.0), "table", start=0.0)
