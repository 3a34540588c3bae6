"""The open, labeled surveys that models are trained on and judged by; what their labels mean.

Labels become 2 ground, 5 vegetation, 6 building, 14 wire, 15 tower and 0, which is left out of
training and scoring.
Low vegetation (3) is left out: in these surveys most of it lies on the ground, and where it begins
is a matter of taste. 3 stands for shrubs that :func:`clouds.find_shrubs` finds among everything
else; they are trained on as vegetation and not scored.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

GROUND, VEGETATION, BUILDING, WIRE, TOWER = 2, 5, 6, 14, 15
SHRUBS = 3


@dataclass(frozen=True)
class LabeledSurvey:
    """One flight.

    Attributes
    ----------
    files : tuple of str
        Under the data folder; where each comes from says `sources.csv`.
    labels : mapping
        The survey's codes -> ours; the others are neighbors only.
    what, license, landscape : str
        For the card.
    group : str
        Surveys of one group are left out of training together when models are judged: one country's
        flights over one kind of landscape, so that a model meets a sensor, an agency's labels and a
        way to build that it has never seen.
    dropped : tuple of int
        Codes that do not even serve as neighbors: noise, points added by computer.
    tall : mapping
        Codes of everything else: vegetation from a height in meters on.
    dimension : str
        That holds the codes.
    low : mapping
        Codes of everything else: ground below a height in meters.
    shrubs : tuple of int
        Codes of everything else that shrubs are looked for in.
    tall_scored : bool
        Whether that is true enough to score by, or to train on only.
    returns : bool
        Whether it records return numbers.
    samples : int
        Of each class from each copy, at most: fewer from what is alike all over, or has one
        building.
    squares : int
        Parts of each copy that are trained on.
    mislabeled : tuple of boxes
        West, south, east, north of where the labels were looked at and are wrong: nothing is
        learned from them, and errors are not counted.
    """

    files: tuple[str, ...]
    labels: Mapping[int, int]
    what: str
    license: str
    landscape: str
    group: str
    dropped: tuple[int, ...] = (7, 18)
    tall: Mapping[int, float] = field(default_factory=dict)
    dimension: str = "classification"
    low: Mapping[int, float] = field(default_factory=dict)
    shrubs: tuple[int, ...] = ()
    tall_scored: bool = False
    returns: bool = True
    samples: int = 1500
    squares: int = 1
    mislabeled: tuple[tuple[float, float, float, float], ...] = ()

    def tells(self, label: int) -> bool:
        """Return whether labels tell a class: it may share a code with the rest."""
        if label not in (VEGETATION, WIRE, TOWER):
            return True
        return label in self.labels.values() or (label == VEGETATION and self.tall_scored)


_LIDARHD = "IGN, LiDAR HD, Licence Ouverte Etalab 2.0"
_AHN = "AHN, open data of the Dutch government"
_NEON = "NEON, open data, CC0"
_ARTEMIS = "Artemis Lab, University of Lethbridge, MIT"
TOWN, FARMLAND, FOREST = "town", "village and farmland", "forest"
SLOPE, COAST = "steep slope", "rocks and scrub"
FRENCH_TOWNS, FRENCH_LAND = "French towns and villages", "French fields, rocks and scrub"
DUTCH, OLD_AND_TALL = "Netherlands", "Spain and Germany"
FORESTS, MOUNTAINS = "North American forests", "mountains of America and New Zealand"
GROUPS = (FRENCH_TOWNS, FRENCH_LAND, DUTCH, OLD_AND_TALL, FORESTS, MOUNTAINS)
CLASSES = {2: GROUND, 4: VEGETATION, 5: VEGETATION, 6: BUILDING}
TWO = {2: GROUND, 6: BUILDING, 9: GROUND}
WILD = {2: GROUND, 4: VEGETATION, 5: VEGETATION}
#: Samples of each class from each copy of what is alike all over, or has one building.
FEW = 12
SURVEYS = {
    "Montpellier": LabeledSurvey(
        (
            "montpellier/train_77050_627755.laz",
            "montpellier/train_77050_627760.laz",
            "montpellier/train_77055_627755.laz",
            "montpellier/train_77055_627760.laz",
        ),
        CLASSES,
        "French city, campus with trees",
        _LIDARHD,
        TOWN,
        group=FRENCH_TOWNS,
    ),
    "Delft": LabeledSurvey(
        ("delft/train.laz",),
        TWO,
        "Dutch old town with canals (AHN3)",
        _AHN,
        TOWN,
        group=DUTCH,
        dropped=(7, 18, 26),
        tall={1: 2.0},
        shrubs=(1,),
    ),
    "Seville": LabeledSurvey(
        ("seville/plazanueva.laz",),
        CLASSES,
        "Spanish old town, closed blocks (PNOA)",
        "Instituto Geografico Nacional de Espana, PNOA, CC BY 4.0",
        TOWN,
        group=OLD_AND_TALL,
        returns=False,
    ),
    "hamlet": LabeledSurvey(
        ("rural/lidarhd_57ppm2.laz",),
        CLASSES,
        "French hamlet on a slope",
        _LIDARHD,
        FARMLAND,
        group=FRENCH_TOWNS,
    ),
    "farm": LabeledSurvey(
        ("rural/lidarhd_11ppm2.laz",),
        {2: GROUND, 6: BUILDING},
        "French farm",
        _LIDARHD,
        FARMLAND,
        group=FRENCH_TOWNS,
        dropped=(7, 18, 208, 214),
        tall={1: 0.5},
        tall_scored=True,
        mislabeled=(
            (870201.0, 6617082.0, 870240.0, 6617108.0),
        ),  # nothing has a label there, nor has the house
    ),
    "power line": LabeledSurvey(
        ("rural/ahn4_powerline.laz",),
        {2: GROUND, 5: VEGETATION, 9: GROUND, 14: WIRE, 15: TOWER},
        "Dutch meadows and woods under a power line (AHN4)",
        _AHN,
        FARMLAND,
        group=DUTCH,
        dropped=(7, 18, 26, 1),
        returns=False,
        samples=FEW,
        squares=5,
    ),
    "bank": LabeledSurvey(
        ("rural/lidarhd_bank.laz",),
        CLASSES,
        "French steep wooded bank and a house",
        _LIDARHD,
        SLOPE,
        group=FRENCH_LAND,
        dropped=(7, 18, 65),
        samples=FEW,
    ),
    "town's edge": LabeledSurvey(
        ("rural/ign_0p3ppm2.laz",),
        CLASSES,
        "French town's edge with large halls, at 0.3 points/m²",
        _LIDARHD,
        TOWN,
        group=FRENCH_TOWNS,
        dropped=(7, 18, 64, 65, 66, 67),
        samples=200,
        mislabeled=(
            (292450.0, 6832080.0, 292645.0, 6832260.0),
        ),  # a roof 11 m above all around is called ground
    ),
    "bridges": LabeledSurvey(
        ("bridge/ign_0299_6802.laz",),
        CLASSES,
        "French river, fields and bridges, at 0.3 points/m²",
        _LIDARHD,
        FARMLAND,
        group=FRENCH_TOWNS,
        dropped=(7, 18, 66, 67),
        samples=200,
    ),
    "meadows": LabeledSurvey(
        ("nl/achterhoek.laz",),
        TWO,
        "Dutch meadows, rows of trees and farms (AHN3)",
        _AHN,
        FARMLAND,
        group=DUTCH,
        tall={1: 2.0},
        shrubs=(1,),
        tall_scored=True,
        samples=FEW,
    ),
    "pines": LabeledSurvey(
        ("us/neon_osbs.laz",),
        {2: GROUND, 5: VEGETATION},
        "Open pine forest in Florida",
        _NEON,
        FOREST,
        group=FORESTS,
        samples=FEW,
    ),
    "Amsterdam": LabeledSurvey(
        ("nl/amsterdam_2386_9702.laz", "nl/amsterdam_2397_9705.laz"),
        TWO,
        "Dutch office blocks, streets with trees and cars (AHN3)",
        _AHN,
        TOWN,
        group=DUTCH,
        tall={1: 2.0},
        shrubs=(1,),
        tall_scored=True,
    ),
    "gardens": LabeledSurvey(
        ("nl/amsterdam_gardens.las",),
        TWO,
        "Dutch houses, sheds and gardens by the water (AHN3), ground mended by hand",
        _AHN,
        TOWN,
        group=DUTCH,
        tall={1: 2.5},
        shrubs=(1,),
        tall_scored=True,
    ),
    "park": LabeledSurvey(
        ("nl/delft_park.las",),
        TWO,
        "Dutch block of flats, parked cars, old trees (AHN3), ground mended by hand",
        _AHN,
        TOWN,
        group=DUTCH,
        tall={1: 2.0},
        shrubs=(1,),
        tall_scored=True,
        samples=FEW,
    ),
    "school": LabeledSurvey(
        ("nl/delft_ahn4.laz",),
        TWO,
        "Dutch flat roof, shrubs, cars, shelters (AHN4)",
        _AHN,
        TOWN,
        group=DUTCH,
        shrubs=(1,),
        samples=FEW,
    ),
    "small town": LabeledSurvey(
        ("fr/town_0382_6565.laz",),
        CLASSES,
        "French small town by the sea, houses with gardens, at 0.3 points/m²",
        _LIDARHD,
        TOWN,
        group=FRENCH_TOWNS,
        dropped=(7, 18, 65, 67),
    ),
    "suburb": LabeledSurvey(
        ("fr/suburb_left.laz", "fr/suburb_right.laz"),
        {2: GROUND, 6: BUILDING},
        "French terraced roofs, trees and cars, at 2.4 points/m²",
        _LIDARHD,
        TOWN,
        group=FRENCH_TOWNS,
    ),
    "Hamburg": LabeledSurvey(
        ("de/hamburg.laz",),
        CLASSES,
        "German street between houses of all heights",
        "Freie und Hansestadt Hamburg, LGV, Datenlizenz Deutschland Namensnennung 2.0",
        TOWN,
        group=OLD_AND_TALL,
        samples=300,
    ),
    "fields": LabeledSurvey(
        ("fr/fields_0484_6632.laz",),
        WILD,
        "French fields with a few trees",
        _LIDARHD,
        FARMLAND,
        group=FRENCH_LAND,
        dropped=(7, 18, 65),
        samples=FEW,
    ),
    "rocks": LabeledSurvey(
        ("fr/corsica.laz",),
        {**WILD, 9: GROUND},
        "Corsican rocks in the sea, up to 40 m high",
        _LIDARHD,
        COAST,
        group=FRENCH_LAND,
        dropped=(7, 18, 65),
        samples=80,
    ),
    "scrub": LabeledSurvey(
        ("fr/scrub_0698_6259.laz",),
        WILD,
        "French hillside with scrub and a bridge",
        _LIDARHD,
        COAST,
        group=FRENCH_LAND,
        dropped=(7, 18, 65),
        samples=80,
    ),
    "river": LabeledSurvey(
        ("fr/river_0689_6735.laz",),
        {**WILD, 9: GROUND},
        "French trees along a river",
        _LIDARHD,
        FOREST,
        group=FRENCH_LAND,
        dropped=(7, 18, 65),
        samples=FEW,
    ),
    "bush": LabeledSurvey(
        ("nz/westport.laz",),
        WILD,
        "New Zealand bush on steep slopes",
        "Toitu Te Whenua LINZ, CC BY 4.0",
        SLOPE,
        group=MOUNTAINS,
        samples=150,
    ),
    "pasture": LabeledSurvey(
        ("us/neon_osbs_2018.laz",),
        {2: GROUND, 5: VEGETATION},
        "Florida grassland with islands of trees",
        _NEON,
        FOREST,
        group=FORESTS,
        samples=FEW,
    ),
    "Rockies": LabeledSurvey(
        ("us/neon_rmnp.las",),
        {2: GROUND, 5: VEGETATION},
        "Colorado mountain forest, heights above ground in place of elevations",
        _NEON,
        FOREST,
        group=FORESTS,
        samples=FEW,
    ),
    "firs": LabeledSurvey(
        ("us/fusion.laz",),
        {2: GROUND},
        "Tall firs on a slope in the western United States",
        "USDA Forest Service, CC0",
        SLOPE,
        group=MOUNTAINS,
        tall={1: 2.0},
        tall_scored=True,
        samples=FEW,
    ),
    "valley": LabeledSurvey(
        ("ca/alberta_sample1_test.laz",),
        {2: VEGETATION},
        "Canadian valley with spruces, trees labeled by hand",
        _ARTEMIS,
        FOREST,
        group=FORESTS,
        dimension="Veg",
        low={1: 0.3},
        samples=FEW,
    ),
    "alps": LabeledSurvey(
        (
            "ca/alberta_sample2_test.laz",
            "ca/alberta_sample3_train.laz",
            "ca/alberta_sample4_test.laz",
        ),
        {2: VEGETATION},
        "Canadian mountain slopes, scree and stunted trees, labeled by hand",
        _ARTEMIS,
        SLOPE,
        group=MOUNTAINS,
        dimension="Veg",
        low={1: 0.3},
        samples=300,
    ),
    "steep": LabeledSurvey(
        ("us/california.las",),
        {2: GROUND},
        "Californian conifers on a slope of 45 degrees",
        "OpenTopography OTLAS.032017.26910.2, CC BY 4.0",
        SLOPE,
        group=MOUNTAINS,
        tall={1: 2.0},
        tall_scored=True,
        samples=FEW,
    ),
}
#: The survey that has labeled wires and a tower.
LINE_SURVEY = "power line"
#: Test parts of two surveys, scored once by the shipped model.
TESTS = {
    "Montpellier": ("montpellier/test_77060_627755.laz", "montpellier/test_77060_627760.laz"),
    "Delft": ("delft/test.laz",),
}
