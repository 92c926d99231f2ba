"""Headings of columns: what they name, in five languages, and the unit that they carry."""

from __future__ import annotations

import re
import unicodedata
from dataclasses import dataclass
from functools import lru_cache

#: What a column holds -> its usual headings in English, German, French, Spanish and Chinese.
_TABLE: dict[str, tuple[str, str, str, str, str]] = {
    "cycle": (
        "cycle, cycle no, cycle number",
        "zyklus, messzyklus, zyklus nr",
        "cycle de mesure",
        "ciclo, ciclo no",
        "循环, 循环号, 循环次数",
    ),
    "run": (
        "run, run no, run number, pass",
        "lauf, messlauf, durchlauf, lauf nr",
        "passe, passage",
        "pasada, corrida, recorrido",
        "测量次数, 次数, 行程",
    ),
    "direction": (
        "direction, approach, direction of approach, approach direction, dir",
        "richtung, anfahrrichtung, verfahrrichtung, messrichtung",
        "sens, sens d'approche, sens de déplacement",
        "dirección, sentido, sentido de aproximación",
        "方向, 接近方向, 趋近方向, 运动方向",
    ),
    "target": (
        "target, target no, target number, point, point no, position no",
        "punkt, messpunkt, zielpunkt, punkt nr, position nr",
        "point de mesure, cible",
        "punto, punto no, objetivo",
        "目标, 目标点, 点号, 测点, 序号",
    ),
    "position": (
        "position, target position, nominal, nominal position, commanded position, programmed position, pos",
        "sollposition, soll, sollwert, zielposition, nennposition",
        "position cible, position nominale, position programmée",
        "posición, posición objetivo, posición nominal, posición programada",
        "位置, 目标位置, 名义位置, 理论位置, 指令位置",
    ),
    "measured": (
        "measured, measured position, actual, actual position, laser position",
        "ist, istposition, istwert, messwert",
        "position mesurée, mesure, position réelle",
        "posición medida, medida, posición real",
        "实测位置, 实测值, 测量值, 实际位置",
    ),
    "deviation": (
        "deviation, error, positioning error, position error, positional error, positional deviation, "
        "positioning deviation, linear error, deviations, errors, positioning errors",
        "abweichung, positionsabweichung, positionierabweichung, fehler, positionierfehler, abweichungen",
        "écart, erreur, écart de position, erreur de position, erreur de positionnement, écarts, erreurs",
        "desviación, error de posición, error de posicionamiento, desviación de posición, desviaciones, errores",
        "偏差, 误差, 位置偏差, 定位误差, 定位偏差, 位置误差",
    ),
    "date": ("date", "datum", "", "fecha", "日期"),
    "time": (
        "time, timestamp, time stamp, date time, datetime, date and time, time of day",
        "zeit, zeitstempel, uhrzeit, datum uhrzeit, datum zeit",
        "heure, horodatage, date heure, date et heure",
        "hora, fecha hora, fecha y hora",
        "时间, 日期时间, 测量时间",
    ),
    "air_temperature": (
        "air temperature, temperature of the air",
        "lufttemperatur, temperatur der luft",
        "température de l'air, température air",
        "temperatura del aire, temperatura aire",
        "空气温度, 气温",
    ),
    "air_pressure": (
        "air pressure, pressure",
        "luftdruck, druck",
        "pression, pression atmosphérique",
        "presión, presión atmosférica",
        "气压, 大气压, 空气压力",
    ),
    "relative_humidity": (
        "relative humidity, humidity",
        "luftfeuchte, relative feuchte, luftfeuchtigkeit, feuchte",
        "humidité, humidité relative",
        "humedad, humedad relativa",
        "湿度, 相对湿度",
    ),
    "material_temperature": (
        "material temperature, sample temperature, workpiece temperature, scale temperature",
        "materialtemperatur, werkstücktemperatur, maschinentemperatur",
        "température matière, température du matériau, température de la pièce",
        "temperatura del material, temperatura material",
        "材料温度, 工件温度, 机床温度",
    ),
}
#: Direction of approach, whether the word names the sign of the travel, and the words. "Forward" only names the first of two runs.
_DIRECTION_TABLE: tuple[tuple[str, bool, str], ...] = (
    ("positive", True, "positive, pos, +, +1, p, positiv, positif, positiva, positivo, ↑, 正, 正方向"),
    ("negative", True, "negative, neg, -, -1, n, negativ, négatif, negativa, negativo, ↓, 负, 负方向"),
    (
        "positive",
        False,
        "forward, forwards, fwd, fw, outward, vorwärts, vor, hin, hinfahrt, aller, avant, avance, adelante, ida, 正向, 前进, 去程",
    ),
    (
        "negative",
        False,
        "reverse, rev, backward, backwards, bwd, bw, return, rückwärts, rück, zurück, rückfahrt, retour, arrière, atrás, vuelta, "
        "retroceso, 反向, 负向, 后退, 回程",
    ),
)

#: Kind of quantity, how its units are written, factor to mm, deg, degC, hPa or percent, and what is added after it.
_UNIT_TABLE: tuple[tuple[str, str, float, float], ...] = (
    ("length", "nm", 1e-6, 0.0),
    ("length", "um, µm, micron, microns, micrometer, micrometre, mikrometer, 微米", 1e-3, 0.0),
    ("length", "mm, millimeter, millimetre, 毫米", 1.0, 0.0),
    ("length", "m", 1e3, 0.0),
    ("length", "inch, inches, in, zoll", 25.4, 0.0),
    ("length", "mil, thou", 25.4e-3, 0.0),
    ("length", "uin, µin, microinch", 25.4e-6, 0.0),
    ("angle", "arcsec, arcsecond, arcseconds, ″, '', \", 角秒, bogensekunden", 1 / 3600, 0.0),
    ("angle", "deg, degree, degrees, °, grad, 度", 1.0, 0.0),
    ("temperature", "degc, °c, ℃, c", 1.0, 0.0),
    ("temperature", "k", 1.0, -273.15),
    ("temperature", "degf, °f, f", 5 / 9, -160 / 9),
    ("pressure", "hpa, mbar", 1.0, 0.0),
    ("pressure", "pa", 1e-2, 0.0),
    ("pressure", "kpa", 10.0, 0.0),
    ("pressure", "mmhg, torr", 1013.25 / 760, 0.0),
    ("pressure", "bar", 1000.0, 0.0),
    ("humidity", "%, percent, %rh, % rh, %rf, % rf", 1.0, 0.0),
)


@dataclass(frozen=True)
class Unit:
    """A unit of a heading.

    Attributes
    ----------
    kind : str
        Kind of quantity: "length", "angle", "temperature", "pressure" or "humidity".
    factor, offset : float
        value * factor + offset is in mm, deg, degC, hPa or percent.
    """

    kind: str
    factor: float
    offset: float


#: Unit as it is written, in lower case -> its meaning.
UNITS = {
    text.strip(): Unit(kind, factor, offset)
    for kind, texts, factor, offset in _UNIT_TABLE
    for text in texts.split(", ")
}

_IN_BRACKETS = re.compile(r"(.*?)\s*[(\[（【{]\s*([^()\[\]（）【】{}]*?)\s*[)\]）】}]\s*(.*)")
_AFTER_MARK = re.compile(r"(.*\S)\s*(?:/|,|;|\sin\s|_|\s)\s*(\S+)")


@dataclass(frozen=True)
class Heading:
    """A heading as it was understood.

    Attributes
    ----------
    text : str
        As in the file.
    role : str or None
        Such as "position" or "deviation"; None where the words are not known.
    unit : str or None
        Key of `UNITS`; None where the heading carries none.
    """

    text: str
    role: str | None
    unit: str | None


def fold(text: str) -> str:
    """Return a text for comparison: lower case, without accents, dots, underscores and surplus spaces.

    Parameters
    ----------
    text : str

    Examples
    --------
    >>> fold("Écart de  Position_")
    'ecart de position'
    """
    plain = "".join(c for c in unicodedata.normalize("NFKD", text.casefold()) if not unicodedata.combining(c))
    return re.sub(r"[\s_.:;,/\\#’'–-]+", " ", plain.replace("º", "o").replace("№", "no")).strip()


def find_unit(text: str) -> str | None:
    """Return the key of a unit as it is written, None where it is none.

    Parameters
    ----------
    text : str
    """
    # Two signs are used for micro: the Greek letter and the micro sign.
    cleaned = text.strip().casefold().replace("μ", "µ").replace("’’", "''")
    return cleaned if cleaned in UNITS else None


@lru_cache(1 << 16)
def read_heading(text: str) -> Heading:
    """Return what a heading names and the unit that it carries.

    Parameters
    ----------
    text : str
        Such as "deviation_um", "Abweichung [µm]", "Écart / µm" or "偏差（μm）".

    Examples
    --------
    >>> read_heading("Sollposition (mm)")
    Heading(text='Sollposition (mm)', role='position', unit='mm')
    """
    name, unit = split_unit(text)
    role = _ROLES.get(fold(name).replace(" ", ""))
    if role == "target" and unit is not None:
        # "Target [mm]" is the position of a target and not its number.
        role = "position"
    return Heading(text, role, unit)


def split_unit(text: str) -> tuple[str, str | None]:
    """Split a heading into name and unit.

    Parameters
    ----------
    text : str

    Returns
    -------
    name : str
    unit : str or None
        Key of `UNITS`.
    """
    match = _IN_BRACKETS.fullmatch(text.strip())
    if match is not None and (unit := find_unit(match[2])) is not None:
        return f"{match[1]} {match[3]}".strip(), unit
    match = _AFTER_MARK.fullmatch(text.strip())
    if match is not None and (unit := find_unit(match[2])) is not None:
        return re.sub(r"(\s+in|\s*[/,;])$", "", match[1]), unit
    return text.strip(), None


def find_direction(text: str) -> tuple[str, bool] | None:
    """Return the direction of approach that a word names.

    Parameters
    ----------
    text : str
        Such as "+", "negative", "Rückwärts", "retour", "正向".

    Returns
    -------
    tuple of (str, bool) or None
        "positive" or "negative", and whether the word names the sign of the travel: "forward" and "reverse" only name the order of the
        runs, and the first run may lead to smaller positions. None where the text is no such word.
    """
    signs = text.strip().replace("−", "-").replace("–", "-").replace("＋", "+").replace("－", "-")
    return _DIRECTIONS.get(_key(signs))


def _split(words: str) -> list[str]:
    return [word for word in words.split(", ") if word]


def _key(word: str) -> str:
    return word if word in _SIGNS else fold(word)


_SIGNS = ("+", "-", "+1", "-1", "↑", "↓")
_ROLES = {
    fold(word).replace(" ", ""): role
    for role, languages in _TABLE.items()
    for words in languages
    for word in _split(words)
}
_DIRECTIONS = {
    _key(word): (direction, signed) for direction, signed, words in _DIRECTION_TABLE for word in _split(words)
}
#: By these, text in the Chinese code page is recognised.
CHINESE_WORDS = tuple(word for languages in _TABLE.values() for word in _split(languages[4]) if len(word) > 1)
