"""Images in shards that lie: refused by what their containers say, before a decoder sees them."""

import struct
import zlib

import numpy as np
import pytest

from lsmgeo.data.images import DEPTH, RGBA, decode_png, encode_png
from tests.data.hostile import TAR, TRIALS, chunk, judged, mutated, read_all, refused, rewritten
from tests.data.shapes import write_set
from tests.fuzz import forked

pytestmark = pytest.mark.timeout(120)


@pytest.fixture
def folder(tmp_path):
    write_set(tmp_path, shards=1, each=2, views=2)
    return tmp_path


def png(width=16, height=12, bits=8, colour=6, interlace=0, data=None, before=b""):
    data = zlib.compress(bytes(height * (1 + 4 * width))) if data is None else data
    start = struct.pack(">IIBBBBB", width, height, bits, colour, 0, 0, interlace)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", start) + before + chunk(b"IDAT", data) + chunk(b"IEND", b"")


PNGS = {
    "nothing": (b"", "is not a PNG"),
    "a JPEG": (b"\xff\xd8\xff\xe0" + bytes(64), "is not a PNG"),
    "a signature": (png()[:8], "is not a PNG"),
    "half": (png()[:60], "ends inside a PNG chunk"),
    "another size": (png(width=17), "is 17 x 12 pixels"),
    "a huge size": (png(width=2**31 - 1, height=2**31 - 1, data=b""), "is 2147483647 x 2147483647 pixels"),
    "16 bits": (png(bits=16), "has bit depth 16, colour type 6"),
    "a palette": (png(colour=3), "has bit depth 8, colour type 3"),
    "interlaced": (png(interlace=1), "interlacing 1"),
    "little data": (png(data=zlib.compress(bytes(100))), "more or less data"),
    "data without end": (png(data=zlib.compress(bytes(12 * 65))[:-4]), "is a damaged image"),
    "a bomb": (png(data=zlib.compress(bytes(1 << 26), 9)), "more or less data"),
    "no compression": (png(data=b"\0" * 100), "is a damaged image"),
    "an unknown filter": (png(data=zlib.compress(b"\5" * 12 * 65)), "is a damaged image"),
    "a wrong check sum": (png(before=chunk(b"IDAT", b"", 1)), "is a damaged image"),
    "two headers": (png(before=png()[8:33]), "is a damaged image"),
    "no header": (b"\x89PNG\r\n\x1a\n" + chunk(b"IEND", b""), "is not a PNG"),
    "a short header": (b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", b"12"), "is not a PNG"),
    "a chunk beyond the end": (png()[:33] + struct.pack(">I", 2**32 - 1) + b"IDAT" + bytes(16), "ends inside"),
    "no data": (png()[:33] + chunk(b"IEND", b""), "more or less data"),
    "more after the end": (png() + b"x", "ends inside a PNG chunk"),
}


@pytest.mark.parametrize("name", PNGS)
def test_images_are_checked(folder, name):
    content, match = PNGS[name]
    rewritten(folder, lambda members: members.update({"00000000.00.png": content}))
    refused(folder, f"00000000.00.png: .*{match}", TAR)


@pytest.mark.parametrize(
    "beside", [b"", chunk(b"PLTE", bytes(3)), chunk(b"tRNS", bytes(6)), chunk(b"acTL", struct.pack(">II", 2**31, 0))]
)
def test_a_valid_image_made_by_hand_is_read_whatever_stands_beside_its_pixels(folder, beside):
    rewritten(folder, lambda members: members.update({"00000000.00.png": png(before=beside)}))
    assert not read_all(folder)[0].mask[0].any()


@pytest.mark.parametrize("kind", [RGBA, DEPTH])
def test_mutated_images_are_refused_or_read(kind):
    """With check sums made to fit, so that inflating and filters are reached."""
    rng = np.random.default_rng(0)
    shape = (12, 16, 4) if kind is RGBA else (12, 16)
    pixels = np.cumsum(rng.integers(0, 3, shape), axis=1).astype(kind.dtype)
    content = encode_png(pixels)
    header, data = content[:33], content[41:-16]
    raw = zlib.decompress(data)

    def judge(number):
        rng = np.random.default_rng([number, 7])
        if number % 3 == 0:
            damaged = mutated(rng, content)
        elif number % 3 == 1:
            damaged = header + chunk(b"IDAT", mutated(rng, data)) + chunk(b"IEND", b"")
        else:
            damaged = header + chunk(b"IDAT", zlib.compress(mutated(rng, raw))) + chunk(b"IEND", b"")

        def run():
            found = decode_png(damaged, (12, 16), kind, "memory")
            assert (found.shape, found.dtype) == (shape, kind.dtype)

        return judged(run)

    came = forked.outcomes(range(TRIALS), judge)
    assert set(came) == {"refused", "read"}
    assert came.count("read") > TRIALS // 10
