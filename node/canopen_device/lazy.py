"""Import the public names of a package when they are first used (PEP 562)."""

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable


def lazy(
    package: str, names: "dict[str, tuple[str, ...]]"
) -> "tuple[Callable[[str], object], Callable[[], list[str]], list[str]]":
    """Return ``__getattr__``, ``__dir__`` and ``__all__`` of a package.

    ``names``: by module below the package, or "/" and another package. A name is followed by ":" and that in the
    module, where it is another one.
    """
    places: dict[str, tuple[str, str]] = {}
    for module, of_module in names.items():
        path = module[1:] if module.startswith("/") else package + "." + module
        for text in of_module:
            name, _, own = text.partition(":")
            places[name] = path, own or name

    def get(name: str) -> object:
        if name not in places:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        path, own = places[name]
        return getattr(__import__(path, None, None, (own,)), own)

    return get, lambda: sorted(places), sorted(places)
