"""What windows of a large tiled scan on a server take: requests, bytes and their share of the file."""

import argparse
import sys
import tempfile
from pathlib import Path

import numpy as np
import tifffile

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))

from range_server import range_server

from measure.scans.opening import open_scan

_MARKS = 8
_MARGIN = 0.06  # of the side, from the picture's edge to a mark


def main() -> None:
    """Print a row for each kind of tile and window."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--side", type=int, default=11_500, help="of the scan, px")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    picture = np.random.default_rng(options.seed).integers(0, 256, (options.side, options.side), np.uint8)
    low, high = _MARGIN * options.side, (1 - _MARGIN) * options.side
    middle = options.side / 2
    places = [(x, y) for x in (low, middle, high) for y in (low, middle, high) if (x, y) != (middle, middle)]
    print("| tiles, px | stored as | windows, px | requests | bytes | share of the file |\n|---|---|---|---|---|---|")
    for tile_px, compression in ((256, "zlib"), (512, "zlib"), (None, None)):
        with tempfile.TemporaryDirectory() as folder, range_server(Path(folder)) as server:
            tile = (tile_px, tile_px) if tile_px else None
            for window_px in (120, 300):
                file = Path(folder) / f"{window_px}.tif"  # of another name, of which nothing is known yet
                tifffile.imwrite(file, picture, tile=tile, compression=compression)
                before = server.gets, server.sent_bytes
                with open_scan(f"{server.url}/{file.name}") as scan:
                    for x, y in places:
                        scan.samples(int(x) - window_px // 2, int(y) - window_px // 2, window_px, window_px)
                gets, sent = server.gets - before[0], server.sent_bytes - before[1]
                share = sent / file.stat().st_size
                print(
                    f"| {tile_px or 'rows'} | {compression or 'uncompressed'} | {_MARKS} of {window_px} "
                    f"| {gets} | {sent:,} | {100 * share:.1f} % |"
                )


if __name__ == "__main__":
    main()
