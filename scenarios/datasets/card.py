"""What goes with a data set: a card for people, and Croissant metadata for programs."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from apu_casadi.core.cf import KEYWORDS
from apu_casadi.core.version import installed
from scenarios.datasets import waveforms

if TYPE_CHECKING:
    from scenarios.datasets.recipe import Recipe

LICENCE = "https://creativecommons.org/licenses/by/4.0/"
_CARD = """\
# {{name}}

{{title}}. Made by apu-casadi {{version}}; program {{program}}. Licence: CC BY 4.0, {{licence}}.
All data are simulated and then measured with noise and gain errors; no engine was run.

{{units}} units, {{runs}} runs of {{duration}} s ({{status}}).

| class | train | validation | test | range |
| --- | --- | --- | --- | --- |
{{classes}}

Splits are by unit: no unit is in two. The split `range` has conditions and loads that the others
do not have.

## Files

- `runs.parquet`: one row a run. `class`, `onset` (s), `over` (s over which it grows), `phase` and
  `generator` of a short circuit, its `h`, `mu`, `kappa`; `mu_f` of a field fault; a faulty
  `sensor`, its kind and relative size; health factors; `unit`, `split`, `status`, `reason`.
- `gaspath/unit_*.parquet`: every 20 ms. `W.` conditions, `X_s.` measured, `X_v.` true, `T.` health
  and severity.
- `electrical/unit_*.nc`: netCDF-4. Voltages and currents of both generators around the onset,
  measured, at {{rate}} Hz; of healthy runs the middle. `v_a(generator, sample)`, with `run` and
  `time` of each sample. Stored in single precision (6e-8, far below noise), packed without loss.
- `checksums.sha256`: `sha256sum -c checksums.sha256`.

## Columns

| column | unit | meaning |
| --- | --- | --- |
{{columns}}

## What it is not

Units differ by the parameters of the recipe's `[spread]` only; gain errors of sensors are drawn for
each run. Faults are one at a time, but for the class `combined`. The models' limits hold here too.

## Recipe

```json
{{recipe}}
```
"""


def data_card(
    r: Recipe,
    rows: Sequence[Mapping[str, Any]],
    columns: Mapping[str, tuple[str, str]],
    told: Mapping[str, Any],
) -> str:
    """Return the card as Markdown."""
    splits = ("train", "validation", "test", "range")
    count = Counter((row["class"], row["split"]) for row in rows)
    kinds = list(dict.fromkeys(r.order))
    classes = [f"| {k} | " + " | ".join(str(count[k, s]) for s in splits) + " |" for k in kinds]
    status = Counter(row["status"] for row in rows)
    table = [f"| `{n}` | {unit} | {doc} |" for n, (unit, doc) in columns.items()]
    table += [f"| `{n}` | {u} | {waveforms.meaning(n)} |" for n, u in waveforms.UNITS.items()]
    values = {
        "name": r.name,
        "title": r.title,
        "version": installed(),
        "program": told["program"],
        "licence": LICENCE,
        "units": r.units,
        "runs": len(rows),
        "duration": f"{r.duration:g}",
        "status": ", ".join(f"{v} {k}" for k, v in sorted(status.items())),
        "classes": "\n".join(classes),
        "rate": f"{r.waveforms.get('rate', 0):g}",
        "columns": "\n".join(table),
        "recipe": json.dumps(told["recipe"], indent=1),
    }
    text = _CARD
    for key, value in values.items():
        text = text.replace("{{" + key + "}}", str(value))
    return text


_PARQUET = "application/x-parquet"
_TYPES = {bool: "sc:Boolean", int: "sc:Integer", float: "sc:Float", str: "sc:Text"}
_WORDS = """
citeAs column equivalentProperty extract field fileObject fileProperty fileSet format includes
isLiveDataset jsonPath key md5 parentField path recordSet references regex repeated replace
samplingRate separator source subField transform
"""
_CONTEXT: dict[str, Any] = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "conformsTo": "dct:conformsTo",
    "cr": "http://mlcommons.org/croissant/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "dct": "http://purl.org/dc/terms/",
    "sc": "https://schema.org/",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "examples": {"@id": "cr:examples", "@type": "@json"},
    **{w: f"cr:{w}" for w in _WORDS.split()},
}


_VARIABLES = ", ".join(f"{n} [{unit}]" for n, unit in waveforms.UNITS.items())
_FOLDERS = {
    "gaspath": (".parquet", _PARQUET, "every 20 ms: conditions, readings, truth"),
    "electrical": (
        waveforms.ENDING,
        waveforms.FORMAT,
        f"netCDF-4, waveforms around the onset: {_VARIABLES} over generator and sample; run and "
        "time of each sample",
    ),
}
"""Ending, format and content of each folder; Croissant 1.0 has no way into netCDF, hence no records
of waveforms: the metadata has their files and says what is in them."""


def croissant(
    r: Recipe,
    sums: Mapping[str, str],
    labels: Mapping[str, Any],
    columns: Mapping[str, tuple[str, str]],
    day: str,
) -> dict[str, Any]:
    """Return Croissant 1.0 metadata, dated: files, and the columns of each table."""
    files: list[dict[str, Any]] = [
        {
            "@type": "cr:FileObject",
            "@id": "runs.parquet",
            "name": "runs.parquet",
            "contentUrl": "runs.parquet",
            "encodingFormat": _PARQUET,
            "sha256": sums["runs.parquet"],
        }
    ]
    folders = sorted({n.split("/")[0] for n in sums if "/" in n})
    files += [
        {
            "@type": "cr:FileSet",
            "@id": folder,
            "name": folder,
            "includes": f"{folder}/*{ending}",
            "encodingFormat": form,
            "description": about,
        }
        for folder, (ending, form, about) in _FOLDERS.items()
        if folder in folders
    ]
    own = {n: (_TYPES[type(v)], "label") for n, v in labels.items()}
    types = {n: "sc:Integer" if n == "run" else "sc:Float" for n in columns}
    gas = {n: (types[n], f"{d} [{u}]") for n, (u, d) in columns.items()}
    sets = [_records("runs", "fileObject", "runs.parquet", own)]
    if "gaspath" in folders:
        sets.append(_records("gaspath_samples", "fileSet", "gaspath", gas))
    return {
        "@context": _CONTEXT,
        "@type": "sc:Dataset",
        "name": r.name,
        "description": r.title,
        "conformsTo": "http://mlcommons.org/croissant/1.0",
        "keywords": list(KEYWORDS),
        "license": LICENCE,
        "version": installed(),
        "datePublished": day,
        "citeAs": f"apu-casadi {installed()}, data set {r.name}, seed {r.seed}",
        "creator": {"@type": "sc:Organization", "name": "apu-casadi developers"},
        "distribution": files,
        "recordSet": sets,
    }


def _records(
    name: str, kind: str, source: str, fields: Mapping[str, tuple[str, str]]
) -> dict[str, Any]:
    made = [
        {
            "@type": "cr:Field",
            "@id": f"{name}/{n}",
            "name": n,
            "description": doc,
            "dataType": data_type,
            "source": {kind: {"@id": source}, "extract": {"column": n}},
        }
        for n, (data_type, doc) in fields.items()
    ]
    return {"@type": "cr:RecordSet", "@id": name, "name": name, "field": made}
