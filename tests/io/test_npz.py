"""NPZ files: shapes before content, no pickles, no bombs, and one error whatever is damaged."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nolbo_ppl.errors import InputError
from nolbo_ppl.io import npz
from nolbo_ppl.io.npz import Npz, read_npz, save_npz


def stored(tmp_path: Path, **arrays: object) -> Path:
    np.savez_compressed(tmp_path / "x.npz", **arrays)
    return tmp_path / "x.npz"


def member(path: Path, name: str, data: bytes) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(name, data)
    return path


def test_round_trip(tmp_path: Path) -> None:
    arrays = {"a/b": np.arange(6.0).reshape(2, 3), "flag": np.array([True]), "name": np.array(["x", "yz"]), "n": np.int64(3)}
    save_npz(tmp_path / "deep" / "x.npz", arrays)
    with Npz(tmp_path / "deep" / "x.npz") as archive:
        assert set(archive.names) == set(arrays)
        for name, value in arrays.items():
            assert np.array_equal(archive.array(name, kinds="fiubU"), value)
        assert archive.headers["a/b"].shape == (2, 3)
    assert read_npz(tmp_path / "deep" / "x.npz", {"a/b": (None, 3)}).keys() == {"a/b"}


def test_another_array_than_expected(tmp_path: Path) -> None:
    path = stored(tmp_path, a=np.ones((2, 3)), text=np.array(["x"]), bad=np.array([1.0, np.nan]))
    for name, shape, message in (
        ("none", None, r"no array `none`: got \['a', 'text', 'bad'\]"),
        ("a", (3, None), r"array `a`: got shape \[2, 3\], expected \[3, any\]"),
        ("a", (2,), r"expected \[2\]"),
        ("text", None, r"array `text`: got type <U1, expected floating point or whole values"),
        ("bad", None, r"array `bad`: got NaN or infinity"),
    ):
        with pytest.raises(InputError, match=r"x\.npz: .*" + message), Npz(path) as archive:
            archive.array(name, shape)
    with Npz(path) as archive:
        assert np.isnan(archive.array("bad", finite=False)[1])


def test_pickles_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"array `a`: got type object"):
        Npz(stored(tmp_path, a=np.array([{"x": 1}], dtype=object)))


def test_bombs_are_refused_before_they_are_unpacked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = stored(tmp_path, covariance=np.zeros((20_000, 6, 6)))
    assert path.stat().st_size < 10_000
    monkeypatch.setattr(npz.npy, "read_array", lambda *_: pytest.fail("unpacked"))
    with pytest.raises(InputError, match=r"at most 1000000 bytes"):
        Npz(path, largest=1_000_000)
    with pytest.raises(InputError, match=r"expected \[3, 6, 6\]"):
        read_npz(path, {"covariance": (3, 6, 6)})


def test_headers_that_promise_more_than_there_is(tmp_path: Path) -> None:
    data = io.BytesIO()
    header = {"descr": "<f8", "fortran_order": False, "shape": (10**13,)}
    np.lib.format.write_array_header_1_0(data, header)
    with pytest.raises(InputError, match=r"array `a`: got shape \(10000000000000,\)"):
        Npz(member(tmp_path / "x.npz", "a.npy", data.getvalue() + bytes(100)))


def test_other_damage(tmp_path: Path) -> None:
    good = stored(tmp_path, a=np.arange(50.0)).read_bytes()
    for content in (b"", b"no archive", good[:100], good[:-30], np.arange(3).tobytes()):
        (tmp_path / "y.npz").write_bytes(content)
        with pytest.raises(InputError, match=r"y\.npz: not a readable NPZ file"):
            Npz(tmp_path / "y.npz")
    for data in (b"", b"\x93NUMPY", b"\x93NUMPY\x01\x00\x10\x00{'descr': '<f8'", b"\x93NUMPY\x09\x00"):
        with pytest.raises(InputError, match=r"y\.npz: array `a` cannot be read"):
            Npz(member(tmp_path / "y.npz", "a.npy", data))
    with pytest.raises(InputError, match="no array"):
        Npz(member(tmp_path / "y.npz", "a.txt", b"hello"))
    np.save(tmp_path / "z.npy", np.arange(3))
    with pytest.raises(InputError, match="not a readable NPZ file"):
        Npz(tmp_path / "z.npy")


@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_any_damage_is_one_error_or_the_same_shape(data: st.DataObject, tmp_path_factory: pytest.TempPathFactory) -> None:
    folder = tmp_path_factory.mktemp("npz")
    good = bytearray(stored(folder, a=np.arange(12.0).reshape(3, 4), b=np.ones(5, np.float32)).read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(good) - 1))
        match data.draw(st.sampled_from(("change", "cut", "insert"))):
            case "change":
                good[at] = data.draw(st.integers(0, 255))
            case "cut":
                del good[at : at + data.draw(st.integers(1, 40))]
            case _:
                good[at:at] = data.draw(st.binary(max_size=20))
        if not good:
            break
    (folder / "x.npz").write_bytes(bytes(good))
    try:
        found = read_npz(folder / "x.npz", {"a": (None, 4), "b": (None,)})
    except InputError as error:
        assert "x.npz" in str(error)
    else:
        assert found["a"].ndim == 2
        assert np.isfinite(found["a"]).all()
