"""See a capture after every step, grade a recording, and write the page that shows both."""

import tempfile
from pathlib import Path

import pcdata
from pcdata.cli.main import main
from pcdata.io import write_capture
from pcdata.synthetic import tabletop

# Two views of a table, in memory and as a folder of captures.
frame = next(iter(tabletop(0, num_views=2, noise="stereo", size=(120, 160)).noisy_frames(1)))
folder = Path(tempfile.mkdtemp())
write_capture(frame, folder / "captures")

# In a notebook the last line of a cell shows each of these; elsewhere save() keeps the page.
cloud = pcdata.ToFrame(frame="base")(pcdata.Deproject()(frame))
print(cloud.summary())
print(cloud.show())
chain = pcdata.Compose(
    [
        pcdata.Deproject(),
        pcdata.ToFrame(frame="base"),
        pcdata.MergeViews(),
        pcdata.RemovePlane(up=(0, 0, 1), frame="base", max_tilt=0.2, keep="above"),
        pcdata.ClusterObjects(eps=0.03, min_points=12, min_size=30),
        pcdata.FarthestPointSample(num_points=512, if_short="repeat"),
    ]
)
print("steps:", chain.show_steps(frame).save(folder / "steps.html"))

# The page of a recording: what is wrong first, then points after each step, the captures, and numbers over time.
assert main(["report", str(folder / "captures"), "--out", str(folder / "report.html")]) == 0
# For a nightly job: 0 where nothing fails, 1 where something does; the reasons say which camera, since when.
print("exit code", main(["grade", str(folder / "captures"), "--json", str(folder / "grade.json")]))
