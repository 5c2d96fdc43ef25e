"""Import the public names of a package when they are first used (PEP 562)."""

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable


def lazy(package: str, names: "dict[str, str]") -> "tuple[Callable[[str], object], Callable[[], list[str]]]":
    """Return ``__getattr__`` and ``__dir__`` of a package; ``names``: module by public name, "" for ``package``."""

    def get(name: str) -> object:
        if name not in names:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        module, _, own = names[name].partition(":")
        return getattr(__import__(package + "." + module, None, None, (own or name,)), own or name)

    return get, lambda: sorted(names)
