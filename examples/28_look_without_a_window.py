"""See captures where no window opens: as matplotlib figures, as pictures of a report, and from a server."""

import json
import tempfile
import threading
import urllib.request
from importlib.util import find_spec
from pathlib import Path

import pcdata
from pcdata.cli.main import main
from pcdata.io import open_source, write_capture
from pcdata.report import figure
from pcdata.report.serving.samples import Samples
from pcdata.report.serving.server import ViewServer
from pcdata.synthetic import tabletop

frame = next(iter(tabletop(0, num_views=2, noise="stereo", size=(120, 160)).noisy_frames(1)))
folder = Path(tempfile.mkdtemp())
write_capture(frame, folder / "captures")
chain = pcdata.Compose(
    [
        pcdata.Deproject(),
        pcdata.ToFrame(frame="base"),
        pcdata.MergeViews(),
        pcdata.EstimateNormals(radius=0.03),
        pcdata.RemovePlane(up=(0, 0, 1), frame="base", max_tilt=0.2, keep="above"),
    ]
)

# A panel for every step and the points that each left; in a notebook the last line of a cell shows it.
steps = figure(chain.step_through(frame), title="what the chain does")
steps.savefig(folder / "steps.png")
# One cloud, colored by several things.
figure(chain(frame), color=["colors", "normals", "height"]).savefig(folder / "colors.png")

# The report as pictures, for a job that mails them; `--png all.png` gives one.
assert main(["report", str(folder / "captures"), "--png", str(folder / "shown")]) == 0
print(sorted(file.name for file in (folder / "shown").iterdir()))

# `pcdata view captures/` opens a browser; this is the server behind it, asked for the first sample by its address.
samples = Samples(open_source(folder / "captures"), chain)
with ViewServer(samples, title="captures") as server:
    threading.Thread(target=server.serve_forever, daemon=True).start()
    with urllib.request.urlopen(f"{server.address}sample/0") as answer:
        sample = json.load(answer)
    server.shutdown()
print([stage["caption"] for stage in sample["stages"]])

# For Rerun: pip install "pcdata[rerun]", then `pcdata view captures/ --rerun`, or a file to open later.
if find_spec("rerun") is not None:
    assert main(["view", str(folder / "captures"), "--rerun", "--out", str(folder / "captures.rrd")]) == 0
