"""`gap.json`, version 2, as a JSON schema: written from the design, not from the code that makes the file."""


def _object(**properties):
    return {"type": "object", "properties": properties, "required": list(properties), "additionalProperties": False}


def _array(items, **more):
    return {"type": "array", "items": items, **more}


TEXT, NUMBER = {"type": "string", "minLength": 1}, {"type": "number"}
SHARE = {"type": "number", "minimum": -1, "maximum": 1}
PROBABILITY = {"type": "number", "minimum": 0, "maximum": 1}
POSITIVE = {"type": "number", "minimum": 0}
INTERVAL = _array(SHARE, minItems=2, maxItems=2)
SITE = _array(TEXT, minItems=1)
CAUSE = {"effect": {"type": "string", "pattern": "^[a-z][a-z0-9_]*$"}, "site": SITE}
PARAMETERS = {
    "type": "object",
    "additionalProperties": _object(value=NUMBER, std=POSITIVE, units=TEXT),
}
STATUS = {"enum": ["no_gap", "explained", "partly", "ambiguous", "unexplained", "not_judged"]}
PLACE = {"experiment": TEXT, "channel": TEXT}


def _nullable(schema):
    return {"anyOf": [schema, {"type": "null"}]}


SCHEMA = _object(
    schema={"const": "jaxfinger-gap/2"},
    data=TEXT,
    specimen={"type": "string"},
    against=_nullable(TEXT),
    verdict=_object(status=STATUS, effects=_array(_object(**CAUSE)), summary=TEXT),
    budget=_array(
        _object(
            **CAUSE,
            probability=PROBABILITY,
            share=SHARE,
            share_ci95=INTERVAL,
            channels={
                "type": "object",
                "propertyNames": {"pattern": "^[A-Z]+[.].+/[a-z_]+$"},
                "additionalProperties": SHARE,
            },
            parameters=PARAMETERS,
        )
    ),
    unexplained=_object(share=SHARE, share_ci95=INTERVAL, depends_on=_array(TEXT), proposal=_nullable(TEXT)),
    relevance=_array(_object(**PLACE, units=TEXT, gap=POSITIVE, signal=POSITIVE, relative=POSITIVE)),
    not_judged=_array(_object(**PLACE, reason=TEXT)),
    where=_array(
        _object(
            experiment=TEXT,
            trial=TEXT,
            channel=TEXT,
            site=TEXT,
            region=_object(variable=TEXT, low=NUMBER, high=NUMBER),
            share=SHARE,
        )
    ),
    candidates=_array(_object(**CAUSE, probability=PROBABILITY, parameters=PARAMETERS, held_out_gain=NUMBER)),
    none=PROBABILITY,
    unlisted=PROBABILITY,
    ambiguous_sets=_array(_array(_object(**CAUSE), minItems=2)),
    next_experiment=_nullable(_object(experiment=TEXT, description=TEXT, separates=_array(TEXT))),
    gap=_array(
        _object(
            **PLACE, units=TEXT, noise=POSITIVE, before=POSITIVE, after=POSITIVE, closed=SHARE, closed_ci95=INTERVAL
        )
    ),
)
