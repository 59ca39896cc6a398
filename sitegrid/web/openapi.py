"""The API's description (OpenAPI 3.1), from the table of resources."""

from __future__ import annotations

from typing import Any

from protocol.queries.parameters import ValueForm
from protocol.version import package_version
from sitegrid.web.resource import Resource
from sitegrid.web.resources import RESOURCES

PREFIX = "/api/v1"
JSON = {ValueForm.NUMBER: "number"}  # types of non-text parameters
PROBLEM = {
    "description": "Refused, or not possible now",
    "content": {"application/problem+json": {"schema": {"$ref": "#/components/schemas/Problem"}}},
}
SITE = {
    "name": "site",
    "in": "path",
    "required": True,
    "description": "name of the site",
    "schema": {"type": "string", "pattern": "^[a-z0-9][a-z0-9_-]{0,62}$"},
}
PROBLEM_SCHEMA = {
    "type": "object",
    "required": ["type", "title", "status", "detail", "reason"],
    "properties": {
        "type": {"type": "string"},
        "title": {"type": "string"},
        "status": {"type": "integer"},
        "detail": {"type": "string"},
        "reason": {"type": "string"},
    },
}


def description() -> dict[str, Any]:
    """The whole description."""
    paths = {f"{PREFIX}/sites/{{site}}/{name}": {"get": _operation(name, one)} for name, one in RESOURCES.items()}
    sites = {
        "summary": "Sites that are served here",
        "operationId": "sites",
        "responses": _responses(("application/json",)),
    }
    return {
        "openapi": "3.1.0",
        "info": {"title": "sitegrid", "version": package_version(), "summary": "The ground, as machines found it"},
        "paths": {f"{PREFIX}/sites": {"get": sites}, **paths},
        "components": {"schemas": {"Problem": PROBLEM_SCHEMA}},
    }


def _operation(name: str, resource: Resource) -> dict[str, Any]:
    parameters = [
        {
            "name": one.name,
            "in": "query",
            "description": one.help,
            "schema": {"type": JSON.get(one.kind.form, "string")},
        }
        for one in resource.parameters.values()
    ]
    return {
        "summary": resource.summary[0].upper() + resource.summary[1:],
        "operationId": name.replace("/", "_"),
        "parameters": [SITE, *parameters],
        "responses": _responses(resource.media),
    }


def _responses(media: tuple[str, ...]) -> dict[str, Any]:
    answer = {"description": "As asked", "content": {kind: {} for kind in media}}
    codes = ("400", "401", "403", "404", "413", "414", "429", "502", "503", "504")
    return {"200": answer, "304": {"description": "As the asker has it"}, **dict.fromkeys(codes, PROBLEM)}
