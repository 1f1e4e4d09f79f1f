"""From regions to objects: which regions belong together, and why.

Sources: Christoph Stein et al., Object partitioning using local convexity, CVPR 2014 (concave contacts part objects);
Richtsfeld et al., Learning of perceptual grouping for object segmentation on RGB-D data, JVCIR 2014 (parts that an
object in front keeps apart).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import combinations

import torch

from pcdata.functional.touching.faces import Face, Scene
from pcdata.functional.touching.limits import KINECT_NOISE

# Regions whose contact is weaker than this on the mean are one object.
PARTS_FROM = 0.35
# Nor does a contact say that they are one which is shorter than this part of the smaller one's width.
_LEAST_LENGTH = 0.3
# Square metres. A face of 6.6 cm2 (250 pixels of a Kinect at 0.85 m) has a plane; 9.2 cm2 have a curvature, 3.2 cm2 a
# strong one; in a bowl, what is below the rim and smaller than 13 cm2 is a part of it.
_FACE, _HOLLOW, _LEAST_HOLLOW, _SLIVER = 6.6e-4, 9.2e-4, 3.2e-4, 1.3e-3
_CONTACT_PIXELS = 5  # fewer are no contact
# The inside of a bowl: mean sine of the rise over tangent planes, and the part that rises. Real bowls have 0.07 to 0.29
# and boxes and cylinders seen from outside less than 0. Of several regions more must rise: two boxes that lean toward
# each other, taken for one, have 0.6 to 0.7.
_HOLLOW_RISE, _HOLLOW_PART, _HOLLOW_PARTS, _NOT_CONVEX = 0.06, 0.6, 0.72, -0.05
_RIM, _WALL_RIM, _WITHIN = 0.015, 0.02, 0.015  # metres
_BELOW_RIM = 0.25  # of its height: what meets an inside higher up meets it over the rim, as the bowl beside it does
_ENCLOSED = 0.9  # part of its border along which an inside must meet higher regions for all of them to be its wall
# Two parts of one face: their planes turn less than 14 degrees, and each other's middle is off by less than 3 cm and by
# no more than that turn explains and 3 degrees that both may be tilted by; one plane fits both nearly as well as each
# its own; they are beside each other, within 25 cm; and the way from one to the other is hidden. Where they touch it is
# seen, and all is stricter; pixels without a reading say nothing, up to half.
_TURN, _TILT, _OFF, _APART, _BESIDE = 14.0, 3.0, 0.03, 0.25, 0.5
_CURVED_RMS = 0.008
_MOST_FREE, _LEAST_HIDDEN, _LEAST_UNSEEN = 0.1, 0.25, 0.6
_TOUCH_TURN, _TOUCH_APART, _TOUCH_SEEN, _TOUCH_UNSEEN, _TOUCH_RMS = 8.0, 0.006, 0.9, 0.5, 0.004

# Why regions were joined that no weak contact joined.
REASONS = ("hollow", "occluded", "touching")


class Objects:
    """Which object each region belongs to: the lowest of its regions."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.object_of = list(range(scene.num_regions))
        self.joins: list[tuple[int, str]] = []
        first, second, strength = (one.cpu() for one in scene.contacts)
        flat = scene.label.flatten().cpu()
        a, b = flat[first], flat[second]
        code = torch.minimum(a, b) * max(scene.num_regions, 1) + torch.maximum(a, b)
        order = torch.argsort(code, stable=True)
        ids, counts = torch.unique_consecutive(code[order], return_counts=True)
        self.sums: dict[tuple[int, int], tuple[float, int]] = {}
        self._rows: dict[tuple[int, int], torch.Tensor] = {}
        for one, rows in zip(ids.tolist(), order.split(counts.tolist())):
            pair = divmod(one, max(scene.num_regions, 1))
            self._rows[pair] = rows
            self.sums[pair] = (float(strength[rows].sum()), len(rows))
        self._faces: dict[tuple[int, ...], Face] = {}

    def members(self) -> dict[int, list[int]]:
        """Return the regions of every object."""
        found: dict[int, list[int]] = {}
        for region, one in enumerate(self.object_of):
            found.setdefault(one, []).append(region)
        return found

    def face(self, regions: list[int]) -> Face:
        """Return the points of regions; computed once."""
        key = tuple(regions)
        if key not in self._faces:
            self._faces[key] = self.scene.face(regions)
        return self._faces[key]

    def join(self, one: int, other: int, why: str | None = None) -> None:
        """Make the objects of two regions one; ``why`` of REASONS, None where their contact is weak."""
        a, b = sorted((self.object_of[one], self.object_of[other]))
        if a == b:
            return
        self.object_of = [a if of == b else of for of in self.object_of]
        if why is not None:
            self.joins.append((one, why))

    def contacts(self) -> dict[tuple[int, int], tuple[float, int, list[tuple[int, int]]]]:
        """Return (sum of strengths, pixels, pairs of regions) of every two objects that touch."""
        found: dict[tuple[int, int], tuple[float, int, list[tuple[int, int]]]] = {}
        for (a, b), (total, count) in self.sums.items():
            x, y = sorted((self.object_of[a], self.object_of[b]))
            if x == y:
                continue
            old_total, old_count, pairs = found.get((x, y), (0.0, 0, []))
            found[x, y] = (old_total + total, old_count + count, [*pairs, (a, b)])
        return found

    def length_of(self, pair: tuple[int, int]) -> float:
        """Return about how long the contact of two regions is, in metres."""
        rows = self._rows[pair]
        depth = self.scene.points[:, 2].cpu()[self.scene.contacts.first.cpu()[rows]]
        return float(depth.sum()) / self.scene.camera.fx

    def contact_pixels(self, pairs: list[tuple[int, int]], of: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the pixels of contacts between regions: those of object ``of``, and their neighbors."""
        rows = torch.cat([self._rows[pair] for pair in pairs])
        first, second = self.scene.contacts.first.cpu()[rows], self.scene.contacts.second.cpu()[rows]
        lookup = torch.tensor(self.object_of, dtype=torch.int64, device="cpu")
        own = lookup[self.scene.label.flatten().cpu()[first]] == of
        return torch.where(own, first, second), torch.where(own, second, first)

    def border_of(self, region: int) -> dict[int, tuple[torch.Tensor, torch.Tensor]]:
        """Return for every region in contact with one: the pixels of that one, and their neighbors in the other."""
        flat = self.scene.label.flatten().cpu()
        found = {}
        for pair, rows in self._rows.items():
            if region not in pair:
                continue
            first, second = self.scene.contacts.first.cpu()[rows], self.scene.contacts.second.cpu()[rows]
            own = flat[first] == region
            found[sum(pair) - region] = torch.where(own, first, second), torch.where(own, second, first)
        return found


def merge_weak_contacts(objects: Objects) -> None:
    """Join the two objects with the weakest contact, until every contact is strong; contacts grow as objects do.

    A contact that is short beside the smaller of the two says nothing: where two things touch at a corner, too few
    points lie around it to show the step.
    """
    area = {one: objects.face([one]).area for one in range(objects.scene.num_regions)}
    contact = {pair: (total, count, objects.length_of(pair)) for pair, (total, count, _) in objects.contacts().items()}

    def joins(pair: tuple[int, int]) -> bool:
        total, count, length = contact[pair]
        return total <= PARTS_FROM * count and length >= _LEAST_LENGTH * math.sqrt(min(area[pair[0]], area[pair[1]]))

    while True:
        weak = [(contact[pair][0] / contact[pair][1], pair) for pair in contact if joins(pair)]
        if not weak:
            return
        kept, gone = min(weak)[1]
        objects.join(kept, gone)
        area[kept] += area.pop(gone)
        joined: dict[tuple[int, int], tuple[float, int, float]] = {}
        for (a, b), found in contact.items():
            x, y = sorted((kept if a == gone else a, kept if b == gone else b))
            if x != y:
                before = joined.get((x, y), (0.0, 0, 0.0))
                joined[x, y] = (before[0] + found[0], before[1] + found[1], before[2] + found[2])
        contact = joined


def join_hollows(objects: Objects) -> None:
    """Join what is inside a bowl, a pot or a cup to it, and the outer wall that its rim hides the foot of.

    Needs heights above the table.
    """
    scene = objects.scene
    if scene.height is None:
        return
    members = objects.members()
    faces = {one: objects.face(regions) for one, regions in members.items()}
    contacts = objects.contacts()
    depth = scene.points[:, 2].cpu()
    for start, face in faces.items():
        if not _is_hollow(face, len(members[start])):
            continue
        rim, seen, todo = face.top, {start}, [start]
        while todo:
            one = todo.pop()
            for pair, (_, count, regions) in contacts.items():
                if one not in pair or count < _CONTACT_PIXELS:
                    continue
                other = pair[1] if pair[0] == one else pair[0]
                if other in seen:
                    continue
                own, beside = objects.contact_pixels(regions, objects.object_of[one])
                behind = float((depth[beside] - depth[own]).median())
                part = faces[other]
                length = float(depth[own].sum()) / scene.camera.fx
                if length < _LEAST_LENGTH * math.sqrt(min(part.area, face.area)):
                    continue
                is_below = part.top < rim + _RIM
                meets = float(scene.height.flatten().cpu()[own].median())
                is_inside = (
                    part.hollow[0] > _NOT_CONVEX
                    and abs(behind) < _WITHIN
                    and is_below
                    and meets < rim - _BELOW_RIM * (rim - face.bottom)
                )
                is_wall = any(_is_wall(objects, pair, objects.object_of[one], rim, depth) for pair in regions)
                if not (is_inside or is_wall or (is_below and part.area < _SLIVER)):
                    continue
                seen.add(other)
                objects.join(start, other, "hollow")
                if is_inside:
                    todo.append(other)
    _join_enclosing(objects, depth)


def _join_enclosing(objects: Objects, depth: torch.Tensor) -> None:
    """Join the regions that enclose the inside of a cup, though it is an object with one of them already.

    Of a small inside the bottom alone is a region, and what stands around it reaches from there over the rim to the
    outer wall; no contact of the two is weak, and the inside does not show in what it has joined.
    """
    beside: dict[int, set[int]] = {}
    for a, b in objects.sums:
        beside.setdefault(a, set()).add(b)
        beside.setdefault(b, set()).add(a)
    for region, others in sorted(beside.items()):
        if len({objects.object_of[one] for one in others} | {objects.object_of[region]}) == 1:
            continue
        inside = objects.face([region])
        if not _is_hollow(inside):
            continue
        wall, sides = [], objects.scene.sides(region)
        for other, (own, next_to) in objects.border_of(region).items():
            part = objects.face([other])
            behind = float((depth[next_to] - depth[own]).median())
            if len(own) < _CONTACT_PIXELS or behind >= objects.scene.noise * float(depth[own].median()) ** 2:
                continue
            if part.top > inside.top:
                wall.append(other)
        if sum(sides[1 + one] for one in wall) > _ENCLOSED * sum(sides):
            for other in wall:
                objects.join(region, other, "hollow")


def _is_hollow(face: Face, num_regions: int = 1) -> bool:
    """Say whether a face is concave as a whole; the smaller it is the clearer, as it has fewer normals to average."""
    if face.area < _LEAST_HOLLOW:
        return False
    rise, part = face.hollow
    least = _HOLLOW_PART if num_regions == 1 else _HOLLOW_PARTS
    return rise > _HOLLOW_RISE * math.sqrt(max(_HOLLOW / face.area, 1.0)) and part > least


def _is_wall(objects: Objects, pair: tuple[int, int], inside: int, rim: float, depth: torch.Tensor) -> bool:
    """Say whether of two regions in contact, one of object ``inside``, the other meets it at the rim, not behind it.

    Not the other's object as a whole: other parts of the wall may have joined it already. Nor the height of the contact
    itself: where the sensor smears the step at the rim, it hangs between both.
    """
    own, beside = objects.contact_pixels([pair], inside)
    if len(own) < _CONTACT_PIXELS:
        return False
    part = objects.face([pair[1] if objects.object_of[pair[0]] == inside else pair[0]])
    return (
        part.hollow[0] <= _HOLLOW_RISE
        and abs(part.top - rim) < _WALL_RIM
        and float((depth[beside] - depth[own]).median()) < objects.scene.noise * float(depth[own].median()) ** 2
        and float(objects.scene.highest_up_ramps(beside).median()) > part.top - _RIM
    )


def join_occluded(objects: Objects) -> None:
    """Join parts of one face that something in front keeps apart, and parts that noise has cut."""
    rough = max(objects.scene.noise / KINECT_NOISE, 1.0)
    faces = list(_plane_faces(objects))
    for (a, one), (b, other) in combinations(faces, 2):
        if objects.object_of[a] == objects.object_of[b]:
            continue
        turn = math.degrees(math.acos(max(-1.0, min(1.0, float(one.normal @ other.normal)))))
        rms, least = max(one.rms, other.rms), min(one.rms, other.rms)
        if turn > _TURN or rms > min(_CURVED_RMS * rough, 2.5 * max(least, 1e-4)):
            continue
        way = other.center - one.center
        off = max(abs(float(way @ one.normal)), abs(float(way @ other.normal)))
        if off > min(_OFF, float(way.norm()) * math.sin(math.radians(turn + _TILT)) + 2 * rms):
            continue
        joint = one.joint_rms(other)
        if joint > 1.15 * rms + 0.0005:
            continue
        distance, between = one.way_to(other)
        if distance > _APART:
            continue
        hidden, on, free, unseen = objects.scene.seen_between(between)
        is_seen = on > _TOUCH_SEEN * (1 - unseen) and unseen < _TOUCH_UNSEEN
        is_cut = turn < _TOUCH_TURN and distance < _TOUCH_APART and is_seen and joint < _TOUCH_RMS * rough
        is_occluded = free < _MOST_FREE and hidden > _LEAST_HIDDEN and hidden + unseen > _LEAST_UNSEEN
        if is_cut or (is_occluded and one.overlap_across(other) > _BESIDE):
            objects.join(a, b, "touching" if is_cut else "occluded")


def _plane_faces(objects: Objects) -> Iterator[tuple[int, Face]]:
    """Yield a region of each face that is large enough to have a plane: regions, then objects of several."""
    for region in range(objects.scene.num_regions):
        face = objects.face([region])
        if face.area >= _FACE:
            yield region, face
    for regions in objects.members().values():
        if len(regions) > 1:
            face = objects.face(regions)
            if face.area >= _FACE:
                yield regions[0], face
