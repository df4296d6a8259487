"""Names that people call the brightest stars by."""

from __future__ import annotations

from functools import cache

# Names of the IAU's Working Group on Star Names, by number in the Hipparcos catalogue: of the 70
# stars that the embedded catalogue has from there, those that have one.
_NAMES = """
677 Alpheratz, 3419 Diphda, 5447 Mirach, 7588 Achernar, 8903 Sheratan, 9640 Almach, 9884 Hamal, 11767 Polaris,
14135 Menkar, 14576 Algol, 15863 Mirfak, 21421 Aldebaran, 24436 Rigel, 24608 Capella, 25336 Bellatrix, 25428 Elnath,
26311 Alnilam, 26727 Alnitak, 27989 Betelgeuse, 28360 Menkalinan, 30324 Mirzam, 30438 Canopus, 31681 Alhena,
32349 Sirius, 33579 Adhara, 34444 Wezen, 36850 Castor, 37279 Procyon, 37826 Pollux, 41037 Avior, 42913 Alsephina,
44816 Suhail, 45238 Miaplacidus, 46390 Alphard, 49669 Regulus, 50583 Algieba, 54061 Dubhe, 57632 Denebola,
59803 Gienah, 60718 Acrux, 61084 Gacrux, 62434 Mimosa, 65474 Spica, 68702 Hadar, 68933 Menkent, 69673 Arcturus,
71681 Toliman, 71683 Rigil Kentaurus, 72607 Kochab, 78401 Dschubba, 80763 Antares, 82273 Atria, 85696 Lesath,
85927 Shaula, 86228 Sargas, 87833 Eltanin, 90185 Kaus Australis, 91262 Vega, 92855 Nunki, 97649 Altair,
100751 Peacock, 102098 Deneb, 107315 Enif, 112122 Tiaki, 113368 Fomalhaut, 113881 Scheat
"""


@cache
def _names() -> dict[str, str]:
    pairs = (entry.split(maxsplit=1) for entry in _NAMES.replace("\n", " ").split(","))
    return {f"HIP {number}": name.strip() for number, name in pairs}


def proper_name(star_id: str) -> str:
    """The name of one of the brightest stars, such as "Vega"; empty for any other."""
    return _names().get(star_id, "")


def short_name(star_id: str, mag: float) -> str:
    """What fits beside a star: its name, else its Hipparcos number, else its magnitude."""
    return proper_name(star_id) or (star_id if star_id.startswith("HIP ") else f"{mag:.1f}")
