"""A CARMEN log with a tilt channel, of a room that nobody needs to believe in: walls, floor and ceiling of a box, seen from its inside by
a scanner that a servo turns from 40 degrees up to 40 degrees down while the robot stands, then drives half a metre.

    carmen_room.py write OUT.log       the log: PANTILT at 50 Hz, FLASER with its pose at 25 Hz
    carmen_room.py judge MESH.ply      (as text) the mesh is that room: status 1 and a sentence where it is not
"""
import math
import sys

LOW, HIGH = (-2.0, -2.5, -1.0), (4.0, 2.5, 1.5)
BEGIN_S, SPEED = 1000000000.0, 20.0  # degrees a second


def tilt(t):
    return math.radians(max(-40.0, min(40.0, -40 + SPEED * t)))


def x_of(t):
    return 0.5 * max(0.0, min(1.0, t - 4.5))


def measured(t, bearing):
    """The box from (x, 0, 0) along a beam; positive tilt looks down."""
    a = tilt(t)
    d = (math.cos(bearing) * math.cos(a), math.sin(bearing), -math.cos(bearing) * math.sin(a))
    o = (x_of(t), 0.0, 0.0)
    return min(((HIGH if d[i] > 0 else LOW)[i] - o[i]) / d[i] for i in range(3) if abs(d[i]) > 1e-9)


def write(path):
    lines = []
    for k in range(310):
        t = k * 0.02
        stamp = f"{BEGIN_S + t:.6f} nobody {t:.6f}"
        lines.append((t, f"PANTILT 0.0 {tilt(t):.9f} {stamp}"))
    for k in range(150):
        end = 0.05 + k * 0.04  # the telegram is there; its first beam was a scan before
        begin = end - 1 / 75
        ranges = " ".join(f"{measured(begin + i * 37.037e-6, math.radians(i - 90)):.4f}" for i in range(181))
        pose = f"{x_of(end):.6f} 0.0 0.0"
        lines.append((end, f"FLASER 181 {ranges} {pose} {pose} {BEGIN_S + end:.6f} nobody {end:.6f}"))
    with open(path, "w", encoding="ascii") as f:
        f.write("# CARMEN Logfile\n")
        f.writelines(line + "\n" for _, line in sorted(lines))


def judge(path):
    lines = open(path, encoding="ascii").read().splitlines()
    n = int(next(line.split()[2] for line in lines if line.startswith("element vertex")))
    at = lines.index("end_header") + 1
    points = [tuple(map(float, line.split()[:3])) for line in lines[at:at + n]]
    faces = [tuple(map(int, line.split()[1:4])) for line in lines[at + n:]]
    area = {}
    for face in faces:
        a, b, c = (points[i] for i in face)
        u, v = ([q - p for p, q in zip(a, w)] for w in (b, c))
        normal = (u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0])
        size = math.sqrt(sum(x * x for x in normal)) / 2
        middle = [(p + q + r) / 3 for p, q, r in zip(a, b, c)]
        away, side = min((abs(middle[i] - end[i]), f"{'xyz'[i]}{end[i]:+g}") for i in range(3) for end in (LOW, HIGH))
        side = side if away < 0.06 else "nowhere"
        area[side] = area.get(side, 0) + size
    print("carmen:", {side: round(m2, 1) for side, m2 in sorted(area.items())})
    whole = sum(area.values())
    seen = {"x+4": 8, "y-2.5": 4, "y+2.5": 4, "z-1": 8, "z+1.5": 4}  # m2 at least
    wrong = [f"{side} has {area.get(side, 0):.1f} m2" for side, m2 in seen.items() if area.get(side, 0) < m2]
    if wrong or area.get("nowhere", 0) > 0.02 * whole:
        sys.exit(f"carmen: not that room: {wrong} {area}")


{"write": write, "judge": judge}[sys.argv[1]](sys.argv[2])
