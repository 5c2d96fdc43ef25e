"""Import the public names of a package when they are first used (PEP 562)."""

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping
    from types import CodeType


def lazy(package: "Mapping[str, object]") -> "tuple[Callable[[str], object], Callable[[], list[str]], list[str]]":
    """Return ``__getattr__``, ``__dir__`` and ``__all__`` of a package, whose globals are given.

    The names are those that its source imports for type checkers, one a line: " from MODULE import NAME as PUBLIC"; a
    program without sources has them in the code of the package."""
    spec: object = package["__spec__"]
    loader, path = spec.loader, spec.origin  # type: ignore[attr-defined]
    places: dict[str, tuple[str, str]] = {}
    # Not get_source(): it imports the tokenizer, a tenth of the time of a short command.
    source: str = loader.get_data(path).decode() if path.endswith(".py") else ""
    if not source:
        places.update(_imported(loader.get_code(spec.name)))  # type: ignore[attr-defined]
    for line in source.splitlines():
        words = line.split()
        if words[:1] == ["from"] and words[4:5] == ["as"]:
            places[words[5]] = words[1], words[3]

    def get(public: str) -> object:
        if public not in places:
            raise AttributeError(f"module {package['__name__']!r} has no attribute {public!r}")
        module, name = places[public]
        return getattr(__import__(module, None, None, (name,)), name)

    return get, lambda: sorted(places), sorted(places)


def _imported(code: "CodeType") -> "Iterator[tuple[str, tuple[str, str]]]":
    import dis

    module = name = ""
    for instruction in dis.get_instructions(code):
        if instruction.opname == "IMPORT_NAME":
            module = instruction.argval
        elif instruction.opname == "STORE_NAME" and name and instruction.argval != "lazy":
            yield instruction.argval, (module, name)
        name = instruction.argval if instruction.opname == "IMPORT_FROM" else ""
