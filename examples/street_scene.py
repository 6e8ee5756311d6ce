"""A street of boxes, cylinders and balls, x along the road, z up, in metres; six cameras on the roof of a car."""

import math

import torch

from lsmgeo import cameras, scenes
from lsmgeo.scenes import Material, Scene, Solid, box, cylinder, sphere

Colour = tuple[float, float, float]
SKY = (0.78, 0.87, 0.95)
SUN = scenes.Lights(
    torch.nn.functional.normalize(torch.tensor([[-0.4, -0.5, 1.0]]), dim=-1),
    torch.full((1, 3), 0.6),
    torch.full((3,), 0.45),
)
CAR = (4.4, 1.8)  # length and width
CARS = {  # place and heading in degrees, and colour
    (9.5, -2.0, 0.0): (0.85, 0.16, 0.14),
    (4.2, 2.4, 180.0): (0.15, 0.38, 0.78),
    (-9.0, -2.2, 3.0): (0.95, 0.72, 0.10),
    (13.5, 3.2, 215.0): (0.92, 0.93, 0.95),
    (-6.5, 5.4, 180.0): (0.10, 0.58, 0.52),
    (2.5, -5.4, 0.0): (0.60, 0.25, 0.62),
}


def car(x: float, y: float, heading: float, colour: Colour) -> list[Solid]:
    """A body, a cabin with a roof, and four wheels."""
    paint, glass, tyre = Material(colour), Material((0.20, 0.25, 0.30)), Material((0.08, 0.08, 0.08))
    parts = [
        box((0, 0, 0.58), (*CAR, 0.66), paint),
        box((-0.25, 0, 1.08), (2.5, 1.6, 0.44), glass),
        box((-0.25, 0, 1.36), (2.4, 1.56, 0.14), paint),
    ]
    parts += [cylinder((a, b - 0.1, 0.33), (a, b + 0.1, 0.33), 0.33, tyre) for a in (-1.4, 1.4) for b in (-0.78, 0.78)]
    return [part.rotated(2, heading).moved((x, y, 0)) for part in parts]


def house(x: float, y: float, colour: Colour) -> list[Solid]:
    """Walls and a flat roof."""
    roof = Material((0.62, 0.36, 0.28))
    return [box((x, y, 3), (11, 6, 6.4), Material(colour)), box((x, y, 6.4), (11.5, 6.5, 0.4), roof)]


def tree(x: float, y: float) -> list[Solid]:
    """A trunk and a crown."""
    leaves = Material((0.26, 0.52, 0.20), "waves", (0.16, 0.38, 0.15), frequency=1.2)
    return [cylinder((x, y, 0), (x, y, 2.2), 0.16, Material((0.38, 0.27, 0.18))), sphere((x, y, 3.1), 1.25, leaves)]


def vehicles() -> Scene:
    """The cars only."""
    return Scene([part for place, colour in CARS.items() for part in car(*place, colour)])


def street() -> Scene:
    """The cars on a road with pavements, houses and trees."""
    asphalt = Material((0.36, 0.37, 0.39), "waves", (0.31, 0.32, 0.34), frequency=0.7)
    stone = Material((0.68, 0.66, 0.62), "checker", (0.62, 0.60, 0.57), frequency=0.5)
    lawn = Material((0.42, 0.60, 0.30), "waves", (0.34, 0.52, 0.25), frequency=0.25)
    white = Material((0.95, 0.95, 0.95))
    solids = [box((0, 0, -0.2), (120, 13, 0.4), asphalt), box((0, 0, -0.5), (120, 120, 0.8), lawn)]
    solids += [box((0, side * 7.75, -0.1), (120, 2.5, 0.5), stone) for side in (-1, 1)]
    solids += [box((x, 0, 0), (2.0, 0.2, 0.02), white) for x in range(-44, 45, 4)]
    solids += [box((6.4, stripe - 5.5, 0), (2.4, 0.5, 0.03), white) for stripe in range(12)]
    solids += house(-13, 13, (0.78, 0.52, 0.42)) + house(3, 13.5, (0.85, 0.78, 0.62))
    solids += house(-4, -13.2, (0.62, 0.66, 0.74)) + house(14, -13, (0.80, 0.62, 0.48))
    for x, y in ((-16, 7.9), (-3, 7.9), (10, 7.9), (-11, -7.9), (6, -7.9), (17, -7.9)):
        solids += tree(x, y)
    return Scene(solids + list(vehicles().solids))


def rig(height: int, width: int) -> cameras.CameraTensors:
    """Six cameras (1, 6), 2 m above the road at (0, 0), one every 60 degrees to the left, 70 degrees wide."""
    angles = torch.arange(6) * math.pi / 3
    ahead = torch.stack((angles.cos(), angles.sin(), torch.zeros(6)), -1)
    eye = 0.6 * ahead + torch.tensor([0.0, 0.0, 2.0])
    poses = cameras.look_at(eye, eye + ahead - torch.tensor([0.0, 0.0, 0.2]), up=(0.0, 0.0, 1.0))
    return _pinholes(poses, 0.5 * width / math.tan(math.radians(35)), height, width)


def from_above(height: int, width: int, metres: float) -> cameras.CameraTensors:
    """A camera (1, 1) so far above the road that its view, `metres` wide, is all but parallel."""
    pose = cameras.look_at((0.0, 0.0, 1000.0), (0.0, 0.0, 0.0), up=(0.0, 1.0, 0.0))
    return _pinholes(pose[None], 1000.0 * width / metres, height, width)


def _pinholes(poses: torch.Tensor, focal: float, height: int, width: int) -> cameras.CameraTensors:
    K = torch.tensor([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
    return cameras.CameraTensors(K.expand(len(poses), 3, 3), poses, height, width).at(None)
