"""GIPP files in their packings give what the plain XML gives; several SPAMOD are distinguished by date."""

import io
import stat
import tarfile
import zipfile
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


@pytest.mark.parametrize(
    "packed",
    [as_dbl, as_data_blocks_in_folders, as_archives, as_one_archive, as_zips, as_one_zip, as_other_encodings],
)
def test_every_packing_is_read_as_the_plain_files_are(packed, plain, tmp_path):
    folder, files = plain
    expected = read_sentinel2(folder / DATASTRIP, folder, "B04")
    assert_same(read_sentinel2(folder / DATASTRIP, packed(tmp_path, files), "B04"), expected)


def tar_with_a_link(target: Path, outside: bytes) -> bytes:
    stream = io.BytesIO()
    with tarfile.open(fileobj=stream, mode="w:gz") as archive:
        link, beyond = tarfile.TarInfo(f"{SPAMOD}.DBL"), tarfile.TarInfo(f"../../{VIEDIR}.DBL")
        link.type, link.linkname, beyond.size = tarfile.SYMTYPE, str(target), len(outside)
        archive.addfile(link)
        archive.addfile(beyond, io.BytesIO(outside))
    return stream.getvalue()


def zip_with_a_link(target: Path, outside: bytes) -> bytes:
    link, stream = zipfile.ZipInfo(f"{SPAMOD}.DBL"), io.BytesIO()
    link.external_attr = (stat.S_IFLNK | 0o777) << 16
    with zipfile.ZipFile(stream, "w") as archive:
        archive.writestr(link, str(target))
        archive.writestr(f"../../{VIEDIR}.DBL", outside)
    return stream.getvalue()


def test_damage_bombs_and_links_are_told_and_nothing_is_written(plain: Plain, tmp_path: Path) -> None:
    folder, files = plain
    members, a = {f"{name}.DBL": raw for name, raw in files.items()}, {f"{VIEDIR}.DBL": b"<a/>"}
    tar, whole = tar_of(members, "gz"), zip_of(members)
    broken, encrypted = bytearray(whole), bytearray(whole)
    broken[200] ^= 0xFF
    for start in (whole.index(b"PK\x03\x04") + 6, whole.index(b"PK\x01\x02") + 8):
        encrypted[start] |= 1  # the flag of both headers
    of_links = folder / f"{SPAMOD}.xml", files[VIEDIR]
    no_member = f"GIPP files: found none of kind SPAMOD, expected {SPAMOD}"
    for name, raw, complaint in (
        ("a.tgz", tar[: len(tar) // 2], "gzip: found"),
        ("a.tgz", b"PK\x03\x04" + bytes(500), "archive: found File is not a zip file"),
        ("a.tgz", b"Rar!" + bytes(500), "byte 257: found no tar archive"),
        ("a.tgz", tar_of({f"{SPAMOD}.tgz": tar_of({"other.xml": b"<a/>"}, "gz")} | a, "gz"), "members"),
        ("a.tgz", tar_of({f"{SPAMOD}.DBL": b"\xff\xfe"} | a, ""), "XML: found .*well-formed"),
        ("a.tgz", tar_with_a_link(*of_links), no_member),
        (
            "a.zip",
            whole[: len(whole) // 2],
            r"a\.zip: archive: found File is not a zip file, expected a whole",
        ),
        ("a.zip", bytes(broken), r"a\.zip: archive: found (Bad CRC-32|Error -3)"),
        ("a.zip", bytes(encrypted), r"a\.zip: archive: found .*is encrypted, password.*without a password"),
        ("a.zip", zip_with_a_link(*of_links), no_member),
    ):
        (tmp_path / name).write_bytes(raw)
        with pytest.raises(RawDataError, match=complaint):
            read_sentinel2(folder / DATASTRIP, tmp_path / name, "B04")
        assert [path.name for path in tmp_path.iterdir()] == [name]
        (tmp_path / name).unlink()


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
