"""A floor plan as a table for people."""

from __future__ import annotations

from slam.mapping.floor_plan import FloorPlan


def floor_plan_text(plan: FloorPlan) -> str:
    """A line a room and a line a door; what has no 95 % interval was not seen whole."""
    doors = sum(door.driven for door in plan.doors)
    lines = [f"{len(plan.rooms)} rooms, {len(plan.doors)} doors, {doors} of them driven through"]
    for room in plan.rooms:
        half = room.area_half_interval_m2
        area = f"about {room.area_m2:.1f} m2" if half is None else f"{room.area_m2:.2f} +- {half:.2f} m2"
        sizes = " x ".join(f"{one.length_m:.3f} +- {one.half_interval_m:.3f} m" for one in room.lengths)
        parts = [f"  room {room.number}: {area}", sizes, "" if room.entered else "never entered"]
        lines.append(", ".join(part for part in parts if part))
    for door in plan.doors:
        how = "" if door.driven else ", not driven through"
        lines.append(f"  door {door.rooms[0]}-{door.rooms[1]}: {door.width_m:.2f} m{how}")
    return "\n".join(lines)
