"""Photographs as phones write them: HEIC, AVIF and JPEG XL files, and colours beyond sRGB."""

from __future__ import annotations

import importlib.util
import struct
from pathlib import Path

import numpy as np
import OpenImageIO
import pytest
from numpy.typing import NDArray
from PIL import Image, ImageCms
from PIL.TiffImagePlugin import IFDRational

from cleargs.errors import InputError
from cleargs.media.colour import linear_from_srgb, srgb_from_hdr, srgb_from_linear
from cleargs.media.image import image_size, read_alpha, read_rgb, stated_focal

P3_FROM_SRGB = np.array([[0.8225, 0.1774, 0.0], [0.0332, 0.9669, 0.0], [0.0171, 0.0724, 0.9108]])
"""Linear light, both with the white point D65."""

COLOURS = np.array([[200, 60, 40], [40, 180, 70], [60, 80, 210], [128, 128, 128]], np.uint8)


def stripes() -> NDArray[np.uint8]:
    """Broad stripes [40, 64, 3], darker in the upper half."""
    picture = np.repeat(np.repeat(COLOURS[None], 40, 0), 16, 1)
    picture[:20] //= 2
    return picture


def display_p3() -> bytes:
    """An ICC profile of Display P3, made of that of sRGB with other primaries."""
    profile = bytearray(ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes())
    primaries = {b"rXYZ": (0.51512, 0.2412, -0.00105), b"gXYZ": (0.29198, 0.69225, 0.04189)}
    primaries[b"bXYZ"] = (0.1571, 0.06657, 0.78407)
    for entry in range(struct.unpack_from(">I", profile, 128)[0]):
        name, offset, size = struct.unpack_from(">4sII", profile, 132 + 12 * entry)
        if name in primaries:
            struct.pack_into(">3i", profile, offset + 8, *(round(65536 * x) for x in primaries[name]))
        if name == b"desc":
            profile[offset + 8 : offset + size] = bytes(size - 8)
    return bytes(profile)


def as_p3(srgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
    light = linear_from_srgb(srgb / 255.0) @ P3_FROM_SRGB.T
    return np.rint(255 * srgb_from_linear(light)).astype(np.uint8)


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".webp", ".tif"])
def test_display_p3_becomes_srgb(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    image = Image.fromarray(as_p3(stripes()))
    image.save(path, icc_profile=display_p3(), quality=100, lossless=True)
    off = np.abs(read_rgb(path).astype(int) - stripes())[8:12, 8::16]  # away from where chroma is mixed
    assert off.max() <= 4
    assert np.abs(as_p3(stripes()).astype(int) - stripes()).max() > 12


def test_an_srgb_profile_changes_nothing(tmp_path: Path) -> None:
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    Image.fromarray(stripes()).save(tmp_path / "a.png", icc_profile=profile)
    assert np.array_equal(read_rgb(tmp_path / "a.png"), stripes())


@pytest.mark.parametrize("profile", [b"", b"no profile at all", display_p3()[:200]])
def test_a_damaged_profile_is_passed_over(tmp_path: Path, profile: bytes) -> None:
    Image.fromarray(stripes()).save(tmp_path / "a.png", icc_profile=profile)
    assert np.array_equal(read_rgb(tmp_path / "a.png"), stripes())


def photo(path: Path, *, turned: bool = False) -> Path:
    """A photograph in the format of the suffix, quality 95; ``turned``: a quarter, by EXIF."""
    exif = Image.Exif()
    exif[274] = 6 if turned else 1
    Image.fromarray(np.rot90(stripes()) if turned else stripes()).save(path, quality=95, exif=exif)
    return path


def test_avif(tmp_path: Path) -> None:
    path = photo(tmp_path / "a.avif")
    assert image_size(path) == (64, 40) and read_alpha(path) is None
    assert np.abs(read_rgb(path).astype(int) - stripes())[5:15, 4::16].max() < 12
    turned = photo(tmp_path / "b.avif", turned=True)
    assert read_rgb(turned).shape == (40, 64, 3) and read_rgb(turned, upright=False).shape == (64, 40, 3)


def test_transparent_avif(tmp_path: Path) -> None:
    picture = np.dstack([stripes(), np.full((40, 64), 255, np.uint8)])
    picture[:, :32, 3] = 0
    Image.fromarray(picture).save(tmp_path / "a.avif", quality=95)
    alpha = read_alpha(tmp_path / "a.avif")
    assert alpha is not None and not alpha[:, :30].any() and alpha[:, 34:].all()


def test_jpeg_xl(tmp_path: Path) -> None:
    assert OpenImageIO.ImageBuf(stripes()).write(str(tmp_path / "a.jxl"))
    assert image_size(tmp_path / "a.jxl") == (64, 40)
    assert np.abs(read_rgb(tmp_path / "a.jxl").astype(int) - stripes())[5:15, 4::16].max() < 12


def test_heic(tmp_path: Path) -> None:
    pytest.importorskip(
        "pillow_heif", reason="the extra cleargs[heif] is not installed"
    ).register_heif_opener()
    path = photo(tmp_path / "a.HEIC")
    assert image_size(path) == (64, 40)
    assert np.abs(read_rgb(path).astype(int) - stripes())[5:15, 4::16].max() < 12
    path.rename(tmp_path / "named-otherwise.jpg")  # as some phones and services hand them out
    assert image_size(tmp_path / "named-otherwise.jpg") == (64, 40)


def test_heic_without_its_package_names_the_remedy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "pillow_heif", None)
    (tmp_path / "a.heic").write_bytes(b"\0\0\0\x18ftypheic" + bytes(12))
    with pytest.raises(InputError, match="pillow-heif") as caught:
        read_rgb(tmp_path / "a.heic")
    assert "cleargs[heif]" in str(caught.value.hint)


@pytest.mark.parametrize("brand", [b"heic", b"avif"])
def test_a_damaged_photo(tmp_path: Path, brand: bytes) -> None:
    if brand == b"heic" and importlib.util.find_spec("pillow_heif") is None:
        pytest.skip("the extra cleargs[heif] is not installed")
    (tmp_path / "a.heic").write_bytes(b"\0\0\0\x18ftyp" + brand + bytes(100))
    with pytest.raises(InputError, match="not an image that can be read"):
        read_rgb(tmp_path / "a.heic")


def test_half_a_photo(tmp_path: Path) -> None:
    path = photo(tmp_path / "a.avif")
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(InputError, match="not an image that can be read"):
        read_rgb(path)


def exif(tags: dict[int, object], orientation: int = 1) -> bytes:
    """EXIF data with these tags in the table of the camera."""
    made = Image.Exif()
    made[274] = orientation
    made.get_ifd(0x8769).update(tags)
    return made.tobytes()


EQUIVALENT = {41989: 26}
"""FocalLengthIn35mmFilm."""


def on_sensor(width: int | None, per_inch: int = 3000, mm: int = 30) -> dict[int, object]:
    """Tags as Canon's DSLRs write them; ``width`` is the size that the camera gave the picture."""
    size = {} if width is None else {40962: width, 40963: width * 2 // 3}
    return {37386: IFDRational(mm, 1), 41486: IFDRational(per_inch, 1), 41488: 2, **size}


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif", ".webp", ".avif", ".heic", ".hif"])
def test_the_focal_length_of_every_format(tmp_path: Path, suffix: str) -> None:
    if suffix in (".heic", ".hif"):
        heif = pytest.importorskip("pillow_heif", reason="the extra cleargs[heif] is not installed")
        heif.register_heif_opener()
    path, kind = tmp_path / f"a{suffix}", "HEIF" if suffix == ".hif" else None
    for tags, share in ((EQUIVALENT, 26 / 43.27 * 1.25), (on_sensor(4000), 30 / 25.4 * 3000 / 4000)):
        Image.new("RGB", (320, 240)).save(path, kind, exif=exif(tags))
        assert stated_focal(path) == pytest.approx(share, rel=1e-12)


@pytest.mark.parametrize("times", [1, 4, 16])
def test_a_reduced_photograph_keeps_its_focal_length(tmp_path: Path, times: int) -> None:
    Image.new("RGB", (4000 // times, 2600 // times)).save(tmp_path / "a.jpg", exif=exif(on_sensor(4000)))
    assert stated_focal(tmp_path / "a.jpg") == pytest.approx(0.8858, rel=1e-3)


@pytest.mark.parametrize(
    "tags",
    [
        {},
        {41989: 0},
        on_sensor(None),
        on_sensor(400),
        {**on_sensor(4000), 41488: 9},
        {**on_sensor(4000), 41486: IFDRational(0, 0)},
        {**on_sensor(4000), 37386: IFDRational(0, 1)},
    ],
)
def test_a_focal_length_that_no_camera_has_is_none(tmp_path: Path, tags: dict[int, object]) -> None:
    Image.new("RGB", (400, 260)).save(tmp_path / "a.jpg", exif=exif(tags))
    assert stated_focal(tmp_path / "a.jpg") is None


@pytest.mark.parametrize("name", ["sRGB", "Display P3 Gamut with sRGB Transfer", "Adobe RGB"])
@pytest.mark.parametrize("wide", [False, True])
def test_a_profile_counts_by_its_content(tmp_path: Path, name: str, wide: bool) -> None:
    plain = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    profile = bytearray(display_p3() if wide else plain)
    for entry in range(struct.unpack_from(">I", profile, 128)[0]):
        kind, offset, size = struct.unpack_from(">4sII", profile, 132 + 12 * entry)
        if kind == b"desc":  # one record of multiLocalizedUnicode; the text may use the old one's place only
            text = name.encode("utf-16-be")[: size - 28]
            record = struct.pack(">4s3I4s2I", b"mluc", 0, 1, 12, b"enUS", len(text), 28)
            profile[offset : offset + size] = (record + text).ljust(size, b"\0")
    stored = as_p3(stripes()) if wide else stripes()
    Image.fromarray(stored).save(tmp_path / "a.png", icc_profile=bytes(profile))
    off = np.abs(read_rgb(tmp_path / "a.png").astype(int) - stripes())
    assert off.max() <= (4 if wide else 0)


def test_a_grey_profile_is_converted(tmp_path: Path) -> None:
    """Linear light, as some scanners store it."""
    curve = struct.pack(">4sIII", b"curv", 0, 0, 0)
    white = struct.pack(">4s4x3i", b"XYZ ", 63190, 65536, 54061)
    start = 132 + 24
    tags = struct.pack(">I", 2) + struct.pack(">4sII4sII", b"wtpt", start, 20, b"kTRC", start + 20, 16)
    head = bytearray(128)
    struct.pack_into(">I4xI4s4s4s", head, 0, start + 36, 0x02400000, b"mntr", b"GRAY", b"XYZ ")
    head[36:40] = b"acsp"
    struct.pack_into(">3i", head, 68, 63190, 65536, 54061)
    profile = bytes(head) + tags + white + curve
    Image.fromarray(np.full((8, 8), 55, np.uint8)).save(tmp_path / "a.png", icc_profile=profile)
    expected = 255 * srgb_from_linear(np.array(55 / 255.0))
    assert abs(int(read_rgb(tmp_path / "a.png")[0, 0, 0]) - expected) <= 2


def test_a_profile_of_inks_is_converted(tmp_path: Path) -> None:
    """As programs for print save JPEGs. Each ink of this one halves the lightness, and black takes all."""
    inks = np.indices((2, 2, 2, 2)).reshape(4, 16)
    lightness = 255 * 0.5 ** inks[:3].sum(axis=0) * (1 - inks[3])
    colours = np.stack([lightness, np.full(16, 128), np.full(16, 128)], axis=1).astype(np.uint8)
    ramp, identity = bytes(range(256)), struct.pack(">9i", *(np.eye(3, dtype=int) * 65536).ravel())
    table = b"mft1" + bytes(4) + bytes([4, 3, 2, 0]) + identity + 4 * ramp + colours.tobytes() + 3 * ramp
    head = bytearray(128)
    struct.pack_into(">I4xI4s4s4s", head, 0, 144 + len(table), 0x02400000, b"prtr", b"CMYK", b"Lab ")
    head[36:40] = b"acsp"
    struct.pack_into(">3i", head, 68, 63190, 65536, 54061)
    profile = bytes(head) + struct.pack(">I4sII", 1, b"A2B0", 144, len(table)) + table
    shown = []
    for ink in ((0, 0, 0, 0), (255, 0, 0, 0), (0, 0, 0, 255)):
        Image.new("CMYK", (16, 16), ink).save(tmp_path / "a.jpg", icc_profile=profile, quality=100)
        shown.append(read_rgb(tmp_path / "a.jpg")[8, 8].tolist())
    assert np.abs(np.array(shown) - np.array([[255] * 3, [119] * 3, [0] * 3])).max() <= 2


def test_a_photograph_for_3d_screens_is_its_first_picture(tmp_path: Path) -> None:
    second = Image.fromarray(stripes()[::-1].copy())
    Image.fromarray(stripes()).save(
        tmp_path / "a.jpg", "MPO", save_all=True, append_images=[second], quality=95
    )
    assert np.abs(read_rgb(tmp_path / "a.jpg").astype(int) - stripes())[5:15, 4::16].max() < 12


@pytest.mark.parametrize("suffix", [".avifs", ".heics"])
def test_of_a_series_in_one_file_the_first_picture_is_read(tmp_path: Path, suffix: str) -> None:
    if suffix == ".heics":
        heif = pytest.importorskip("pillow_heif", reason="the extra cleargs[heif] is not installed")
        heif.register_heif_opener()
    path, kind = tmp_path / f"a{suffix}", "HEIF" if suffix == ".heics" else "AVIF"
    second = Image.fromarray(stripes()[::-1].copy())
    Image.fromarray(stripes()).save(path, kind, save_all=True, append_images=[second], quality=95)
    assert image_size(path) == (64, 40)
    assert np.abs(read_rgb(path).astype(int) - stripes())[5:15, 4::16].max() < 12


@pytest.mark.parametrize("name", ["a.mpo", "a.avifs", "a.HIF", "a.heics"])
def test_the_first_picture_of_several_is_read(tmp_path: Path, name: str) -> None:
    """Pictures for 3D screens, animations, and what Canon, Sony and bursts of phones write."""
    kind = {"mpo": "MPO", "avifs": "AVIF"}.get(name[2:], "HEIF")
    if kind == "HEIF":
        reason = "the extra cleargs[heif] is not installed"
        pytest.importorskip("pillow_heif", reason=reason).register_heif_opener()
    other = Image.fromarray(255 - stripes())
    Image.fromarray(stripes()).save(tmp_path / name, kind, save_all=True, append_images=[other], quality=95)
    assert image_size(tmp_path / name) == (64, 40)
    assert np.abs(read_rgb(tmp_path / name).astype(int) - stripes())[5:15, 4::16].max() < 12


@pytest.mark.parametrize(("transfer", "code"), [("pq", 16), ("hlg", 18)])
@pytest.mark.parametrize("suffix", [".HIF", ".avif"])
def test_hdr_photographs_are_tone_mapped(tmp_path: Path, suffix: str, transfer: str, code: int) -> None:
    """As Canon's and Sony's cameras write them."""
    path, levels = tmp_path / f"a{suffix}", np.array([40, 90, 150, 200], np.uint8)
    picture = Image.fromarray(np.repeat(np.repeat(levels[None, :, None], 40, 0), 16, 1).repeat(3, 2))
    if suffix == ".HIF":
        heif = pytest.importorskip("pillow_heif", reason="the extra cleargs[heif] is not installed")
        signal = {"color_primaries": 9, "transfer_characteristics": code, "matrix_coefficients": 9}
        heif.from_pillow(picture).save(path, quality=100, full_range_flag=1, **signal)
    else:
        picture.save(path, quality=100)
        data = path.read_bytes()
        place = data.index(b"colrnclx") + 8
        path.write_bytes(data[:place] + struct.pack(">HH", 9, code) + data[place + 4 :])
    expected = 255 * srgb_from_hdr(np.repeat(levels[None, :, None] / 255.0, 3, 2), transfer)
    assert np.abs(read_rgb(path)[20, 8::16] - expected[0]).max() < 5


@pytest.mark.parametrize("kind", [np.float32, np.int32])
def test_measured_numbers_are_no_photograph(tmp_path: Path, kind: type[np.generic]) -> None:
    """As programs of thermal cameras export them: they would all be black or all white."""
    Image.fromarray(np.full((24, 32), 293, kind)).save(tmp_path / "a.tif")
    with pytest.raises(InputError, match="not colours") as refused:
        read_rgb(tmp_path / "a.tif")
    assert "8 or 16 bits" in str(refused.value.hint)
