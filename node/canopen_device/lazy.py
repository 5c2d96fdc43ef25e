"""Import the public names of a package when they are first used (PEP 562)."""

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable, Mapping


def lazy(
    package: "Mapping[str, object]",
) -> "tuple[Callable[[str], object], Callable[[], list[str]], list[str]]":
    """Return ``__getattr__``, ``__dir__`` and ``__all__`` of a package, whose globals are given.

    The names are those that its source imports for type checkers, one a line: "    from MODULE import NAME as PUBLIC".
    """
    spec: object = package["__spec__"]
    source: str = spec.loader.get_source(spec.name)  # type: ignore[attr-defined]
    places: dict[str, tuple[str, str]] = {}
    for line in source.splitlines():
        words = line.split()
        if words[:1] == ["from"] and words[4:5] == ["as"]:
            places[words[5]] = words[1], words[3]

    def get(public: str) -> object:
        if public not in places:
            raise AttributeError(f"module {package['__name__']!r} has no attribute {public!r}")
        path, name = places[public]
        return getattr(__import__(path, None, None, (name,)), name)

    return get, lambda: sorted(places), sorted(places)
