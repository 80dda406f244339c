"""GIPP files in their packings give what the plain XML gives; several SPAMOD are distinguished by date."""

import io
import stat
import tarfile
import zipfile
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from handmade_sentinel2 import DATASTRIP, SPAMOD, VIEDIR, write_sentinel2

from boresight.features.operators.sentinel2_product import Sentinel2, read_sentinel2
from boresight.pipeline.errors import RawDataError

Files = dict[str, bytes]
Plain = tuple[Path, Files]  # the folder with the plain files, and what they hold


def tar_of(members: dict[str, bytes], mode: str) -> bytes:
    stream = io.BytesIO()
    with tarfile.open(fileobj=stream, mode=f"w:{mode}") as archive:
        for name, raw in members.items():
            info = tarfile.TarInfo(name)
            info.size = len(raw)
            archive.addfile(info, io.BytesIO(raw))
    return stream.getvalue()


def in_data_block(raw: bytes) -> bytes:
    body = raw.decode().partition("?>")[2] if raw.startswith(b"<?xml") else raw.decode()
    head = "<Earth_Explorer_Header><Fixed_Header/></Earth_Explorer_Header>"
    return f'<Earth_Explorer_File xmlns="http://x">{head}<Data_Block type="xml">{body}</Data_Block></Earth_Explorer_File>'.encode()  # noqa: E501


HEADER = b"<Earth_Explorer_Header/>"


def as_dbl(place: Path, files: Files) -> Path:
    for name, raw in files.items():
        (place / f"{name}.DBL").write_bytes(raw)
        (place / f"{name}.HDR").write_bytes(HEADER)
    return place


def as_data_blocks_in_folders(place: Path, files: Files) -> Path:
    for name, raw in files.items():
        (place / name).mkdir()
        (place / name / f"{name}.DBL").write_bytes(in_data_block(raw))
    return place


def as_archives(place: Path, files: Files) -> Path:
    for suffix, (name, raw) in zip(("tar.gz", "TGZ"), files.items()):
        inside = {f"{name}/{name}.HDR": HEADER, f"{name}/{name}.DBL": raw}
        (place / f"{name}.{suffix}").write_bytes(tar_of(inside, "gz"))
    return place


def as_one_archive(place: Path, files: Files) -> Path:
    inside = {f"GIPP/{name}.tgz": tar_of({f"{name}.DBL": raw}, "gz") for name, raw in files.items()}
    (place / "gipp.tar").write_bytes(tar_of(inside | {"GIPP/README": b"all"}, ""))
    return place / "gipp.tar"


def as_other_encodings(place: Path, files: Files) -> Path:
    """The same text in UTF-16, and in ISO 8859-1 with a letter beyond ASCII in a comment."""
    for n, (name, raw) in enumerate(files.items()):
        body = raw.decode().partition("?>")[2] or raw.decode()
        latin = f'<?xml version="1.0" encoding="ISO-8859-1"?><!-- \xe9 -->{body}'.encode("latin-1")
        (place / f"{name}.xml").write_bytes(body.encode("utf-16") if n % 2 else latin)
    return place


def zip_of(members: dict[str, bytes], compression: int = zipfile.ZIP_DEFLATED) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", compression) as archive:
        for name, raw in members.items():
            archive.writestr(name, raw)
    return stream.getvalue()


def as_zips(place: Path, files: Files) -> Path:
    for n, (name, raw) in enumerate(files.items()):
        inside = {f"{name}/{name}.HDR": HEADER, f"{name}/{name}.DBL": raw}
        (place / f"{name}.ZIP").write_bytes(zip_of(inside, (zipfile.ZIP_DEFLATED, zipfile.ZIP_STORED)[n % 2]))
    return place


def as_one_zip(place: Path, files: Files) -> Path:
    (spamod, first), (viedir, second) = files.items()
    inside = {f"GIPP/{spamod}.tgz": tar_of({f"{spamod}.DBL": first}, "gz")}
    inside |= {f"GIPP/{viedir}.zip": zip_of({f"{viedir}.DBL": second}), "GIPP/README": b"all"}
    (place / "gipp.zip").write_bytes(zip_of(inside))
    return place / "gipp.zip"


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Plain:
    folder = tmp_path_factory.mktemp("plain")
    write_sentinel2(folder)
    return folder, {name: (folder / f"{name}.xml").read_bytes() for name in (SPAMOD, VIEDIR)}


def assert_same(found: Sentinel2, expected: Sentinel2) -> None:
    assert np.array_equal(found.mounting_angles_rad, expected.mounting_angles_rad)
    assert np.array_equal(found.R_ps["STR2"].as_quat(), expected.R_ps["STR2"].as_quat())
    samples = np.arange(24.0)
    for ccd in range(2):
        there, here = (one.camera.directions_from_pixels(ccd, samples) for one in (found, expected))
        assert np.array_equal(there, here)


def assert_refused(datastrip: Path, place: Path, raw: bytes, complaint: str) -> None:
    place.write_bytes(raw)
    with pytest.raises(RawDataError, match=complaint):
        read_sentinel2(datastrip, place, "B04")


@pytest.mark.parametrize(
    "packed",
    [as_dbl, as_data_blocks_in_folders, as_archives, as_one_archive, as_zips, as_one_zip, as_other_encodings],
)
def test_every_packing_is_read_as_the_plain_files_are(packed, plain, tmp_path):
    folder, files = plain
    expected = read_sentinel2(folder / DATASTRIP, folder, "B04")
    assert_same(read_sentinel2(folder / DATASTRIP, packed(tmp_path, files), "B04"), expected)


def test_nothing_is_written_and_links_are_no_members(plain: Plain, tmp_path: Path) -> None:
    folder, files = plain
    stream = io.BytesIO()
    with tarfile.open(fileobj=stream, mode="w:gz") as archive:
        link = tarfile.TarInfo(f"{SPAMOD}.DBL")
        link.type, link.linkname = tarfile.SYMTYPE, str(folder / f"{SPAMOD}.xml")
        archive.addfile(link)
        outside = tarfile.TarInfo(f"../../{VIEDIR}.DBL")
        outside.size = len(files[VIEDIR])
        archive.addfile(outside, io.BytesIO(files[VIEDIR]))
    none = f"GIPP files: found none of kind SPAMOD, expected {SPAMOD}"
    assert_refused(folder / DATASTRIP, tmp_path / "gipp.tgz", stream.getvalue(), none)
    assert [path.name for path in tmp_path.iterdir()] == ["gipp.tgz"]


def test_damage_and_bombs_are_told(plain: Plain, tmp_path: Path) -> None:
    folder, files = plain
    whole = tar_of({f"{name}.DBL": raw for name, raw in files.items()}, "gz")
    for raw, complaint in (
        (whole[: len(whole) // 2], "gzip: found"),
        (b"PK\x03\x04" + bytes(500), "archive: found File is not a zip file"),
        (b"Rar!" + bytes(500), "byte 257: found no tar archive"),
        (
            tar_of({f"{SPAMOD}.tgz": tar_of({"other.xml": b"<a/>"}, "gz"), f"{VIEDIR}.xml": b"<a/>"}, "gz"),
            "members",
        ),
        (tar_of({f"{SPAMOD}.DBL": b"\xff\xfe", f"{VIEDIR}.DBL": b"<a/>"}, ""), "XML: found .*well-formed"),
    ):
        assert_refused(folder / DATASTRIP, tmp_path / "gipp.tgz", raw, complaint)


def test_damaged_zips_links_and_bombs_are_told(plain: Plain, tmp_path: Path) -> None:
    folder, files = plain
    refused = partial(assert_refused, folder / DATASTRIP, tmp_path / "gipp.zip")
    whole = zip_of({f"{name}.DBL": raw for name, raw in files.items()})
    refused(whole[: len(whole) // 2], r"gipp\.zip: archive: found File is not a zip file, expected a whole")
    broken = bytearray(whole)
    broken[200] ^= 0xFF
    refused(bytes(broken), r"gipp\.zip: archive: found (Bad CRC-32|Error -3)")
    encrypted = bytearray(whole)
    for start in (whole.index(b"PK\x03\x04") + 6, whole.index(b"PK\x01\x02") + 8):
        encrypted[start] |= 1  # the flag of both headers
    refused(bytes(encrypted), r"gipp\.zip: archive: found .*is encrypted, password.*without a password")
    link = zipfile.ZipInfo(f"{SPAMOD}.DBL")
    link.external_attr = (stat.S_IFLNK | 0o777) << 16
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        archive.writestr(link, str(folder / f"{SPAMOD}.xml"))
        archive.writestr(f"../../{VIEDIR}.DBL", files[VIEDIR])
    refused(stream.getvalue(), f"GIPP files: found none of kind SPAMOD, expected {SPAMOD}")
    assert [path.name for path in tmp_path.iterdir()] == ["gipp.zip"]


OLD, NEW, LATE = (
    f"S2A_OPER_GIP_SPAMOD_MPC__20190101T000000_V{span}_B00"
    for span in (
        "20150703T000000_20190101T000000",
        "20190101T000000_21000101T000000",
        "20200101T000000_21000101T000000",
    )
)


def test_of_several_mountings_the_one_valid_at_the_date_is_taken(plain: Plain, tmp_path: Path) -> None:
    folder, files = plain
    as_dbl(tmp_path, {OLD: b"<damaged", NEW: files[SPAMOD], VIEDIR: files[VIEDIR]})
    text = (folder / DATASTRIP).read_text()
    assert f"<GIPP_FILENAME>{SPAMOD}</GIPP_FILENAME>" in text

    def naming(*names: str) -> Path:
        listed = "".join(f"<GIPP_FILENAME>{name}</GIPP_FILENAME>" for name in names)
        (tmp_path / DATASTRIP).write_text(text.replace(f"<GIPP_FILENAME>{SPAMOD}</GIPP_FILENAME>", listed))
        return tmp_path / DATASTRIP

    expected = read_sentinel2(folder / DATASTRIP, folder, "B04")
    assert_same(read_sentinel2(naming(OLD, NEW), tmp_path, "B04"), expected)
    assert_same(read_sentinel2(naming(NEW, LATE), tmp_path, "B04"), expected)  # the other one is not there
    with pytest.raises(RawDataError, match=f"GIPP files: found {OLD}, {NEW}, expected {LATE}"):
        read_sentinel2(naming(LATE), tmp_path, "B04")
    as_dbl(tmp_path, {LATE: files[SPAMOD]})
    expected_text = f"found 2 files SPAMOD of B00 valid at 20200816T120202, expected .*{NEW} or {LATE}"
    with pytest.raises(RawDataError, match=expected_text):
        read_sentinel2(naming(OLD, NEW, LATE), tmp_path, "B04")
