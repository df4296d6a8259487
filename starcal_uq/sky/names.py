"""Names that people call bright stars by."""

from __future__ import annotations

from functools import cache

# Names of the IAU's Working Group on Star Names: of the 70 stars that the embedded catalogue has from Hipparcos,
# and of those of Gaia that stand within 0.3 arcsec (Ankaa 1.2) of their places at J2000 in the table of PyEphem
# 4.2.1, which is made from Hipparcos and the group's list.
_NAMES = """
HIP 677: Alpheratz, HIP 3419: Diphda, HIP 5447: Mirach, HIP 7588: Achernar, HIP 8903: Sheratan, HIP 9640: Almach,
HIP 9884: Hamal, HIP 11767: Polaris, HIP 14135: Menkar, HIP 14576: Algol, HIP 15863: Mirfak, HIP 21421: Aldebaran,
HIP 24436: Rigel, HIP 24608: Capella, HIP 25336: Bellatrix, HIP 25428: Elnath, HIP 26311: Alnilam, HIP 26727: Alnitak,
HIP 27989: Betelgeuse, HIP 28360: Menkalinan, HIP 30324: Mirzam, HIP 30438: Canopus, HIP 31681: Alhena,
HIP 32349: Sirius, HIP 33579: Adhara, HIP 34444: Wezen, HIP 36850: Castor, HIP 37279: Procyon, HIP 37826: Pollux,
HIP 41037: Avior, HIP 42913: Alsephina, HIP 44816: Suhail, HIP 45238: Miaplacidus, HIP 46390: Alphard,
HIP 49669: Regulus, HIP 50583: Algieba, HIP 54061: Dubhe, HIP 57632: Denebola, HIP 59803: Gienah, HIP 60718: Acrux,
HIP 61084: Gacrux, HIP 62434: Mimosa, HIP 65474: Spica, HIP 68702: Hadar, HIP 68933: Menkent, HIP 69673: Arcturus,
HIP 71681: Toliman, HIP 71683: Rigil Kentaurus, HIP 72607: Kochab, HIP 78401: Dschubba, HIP 80763: Antares,
HIP 82273: Atria, HIP 85696: Lesath, HIP 85927: Shaula, HIP 86228: Sargas, HIP 87833: Eltanin,
HIP 90185: Kaus Australis, HIP 91262: Vega, HIP 92855: Nunki, HIP 97649: Altair, HIP 100751: Peacock,
HIP 102098: Deneb, HIP 107315: Enif, HIP 112122: Tiaki, HIP 113368: Fomalhaut, HIP 113881: Scheat,
Gaia DR3 5044368071870093312: Acamar, Gaia DR3 2026116260337482112: Albireo, Gaia DR3 1565090003967879424: Alcor,
Gaia DR3 66714384142368256: Alcyone, Gaia DR3 2193192137376175488: Alderamin, Gaia DR3 2272185759996420992: Alfirk,
Gaia DR3 2769202742740232960: Algenib, Gaia DR3 1576683529448755328: Alioth, Gaia DR3 1510374147844219904: Alkaid,
Gaia DR3 6560604777055249536: Alnair, Gaia DR3 1222646935698492160: Alphecca, Gaia DR3 4296708789290712064: Alshain,
Gaia DR3 4993479684438433792: Ankaa, Gaia DR3 6664407333374099968: Arkab Posterior,
Gaia DR3 6664464851576141824: Arkab Prior, Gaia DR3 2971266110612490624: Arneb, Gaia DR3 66526127137440128: Atlas,
Gaia DR3 423018377034969216: Caph, Gaia DR3 4473334474604992384: Cebalrai, Gaia DR3 65271996684817280: Electra,
Gaia DR3 1279798794197267072: Izar, Gaia DR3 65283232316451328: Maia, Gaia DR3 2816504901198512768: Markab,
Gaia DR3 1575287046603605888: Megrez, Gaia DR3 856096765753549056: Merak, Gaia DR3 65205373152172032: Merope,
Gaia DR3 3490234568129160704: Minkar, Gaia DR3 3220756843825383936: Mintaka, Gaia DR3 1563590579347125632: Mizar,
Gaia DR3 5534788672055388032: Naos, Gaia DR3 2968097043228517120: Nihal, Gaia DR3 792588939773693568: Phecda,
Gaia DR3 4493746564376875520: Rasalhague, Gaia DR3 6713727061309245952: Rukbat, Gaia DR3 4136366183978856960: Sabik,
Gaia DR3 2680356911816018048: Sadalmelik, Gaia DR3 2067518817314952576: Sadr, Gaia DR3 3011968416163350272: Saiph,
Gaia DR3 418551920284673408: Schedar, Gaia DR3 2090687795056051328: Sheliak, Gaia DR3 2043823929421342848: Sulafat,
Gaia DR3 4302054339959905920: Tarazed, Gaia DR3 65296907494549120: Taygeta, Gaia DR3 1667976701458958848: Thuban,
Gaia DR3 4429785739602747392: Unukalhai, Gaia DR3 3736865265441207424: Vindemiatrix,
Gaia DR3 5111187420714898304: Zaurak, Gaia DR3 6309703507861332736: Zubenelgenubi
"""


@cache
def _names() -> dict[str, str]:
    return dict(entry.split(": ") for entry in " ".join(_NAMES.split()).split(", "))


def proper_name(star_id: str) -> str:
    """The name of a bright star, such as "Vega"; empty for any other."""
    return _names().get(star_id, "")


def short_name(star_id: str, mag: float) -> str:
    """What fits beside a star: its name, else its Hipparcos number, else its magnitude."""
    return proper_name(star_id) or (star_id if star_id.startswith("HIP ") else f"G {mag:.1f}")
