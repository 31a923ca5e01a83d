"""Two directives of the reference.

``names`` makes a table of public names and then shows each at length; the word after it is their
module below ``dpdjax``, none for the names of the package itself:

    ```{names} laws
    soft_repulsion
    morse
    ```

``commands`` shows what each command says of itself. References by the last part of a name, as
docstrings have them, are resolved here.
"""

import argparse
import inspect
import os
from importlib import import_module

from docutils import nodes
from docutils.parsers.rst import Directive
from docutils.statemachine import StringList
from sphinx.util.nodes import make_refnode


def kind_of(value) -> str:
    if inspect.isclass(value):
        return "autoexception" if issubclass(value, Exception) else "autoclass"
    return "autofunction" if callable(value) else "autodata"


class Names(Directive):
    has_content = True
    optional_arguments = 1

    def run(self):
        home = ".".join(["dpdjax", *self.arguments])
        module = import_module(home)
        table = [".. autosummary::", "   :nosignatures:", ""]
        table += [f"   {home}.{name}" for name in self.content]
        return parsed(self, [*table, "", *self.at_length(home, module)])

    def at_length(self, home, module):
        for name in self.content:
            value = getattr(module, name)
            yield f".. {kind_of(value)}:: {home}.{name}"
            if inspect.isclass(value):
                yield "   :members:"
            yield ""


def parsed(directive, lines) -> list:
    """Nodes of lines of reStructuredText in a page of Markdown."""
    where = nodes.container()
    lines = ["```{eval-rst}", *lines, "```"]
    source = directive.state.document.current_source
    directive.state.nested_parse(StringList(lines, source=source), 0, where)
    return where.children


class Commands(Directive):
    def run(self):
        from dpdjax.cli import parser as of_all

        os.environ["COLUMNS"] = "96"
        parser = of_all()
        choices = next(
            a.choices for a in parser._actions if isinstance(a, argparse._SubParsersAction)
        )
        return [node for name, each in choices.items() for node in self.shown(name, each)]

    def shown(self, name, parser):
        section = nodes.section(ids=[f"dpdjax-{name}"])
        section += nodes.title(text=f"dpdjax {name}")
        section += nodes.literal_block(text=parser.format_help(), language="none")
        self.state.document.note_implicit_target(section, section)
        yield section


def by_last_part(app, env, node, near):
    """The one documented object that has the name, or its last part."""
    if node.get("refdomain") != "py":
        return None
    domain = env.get_domain("py")
    last = node["reftarget"].rpartition(".")[2]
    found = [name for name in domain.objects if name.rpartition(".")[2] == last]
    public = [name for name in found if name.count(".") <= 2]
    if len(public or found) != 1:
        return None
    name = (public or found)[0]
    entry = domain.objects[name]
    here = node.get("refdoc", "index")
    return make_refnode(app.builder, here, entry.docname, entry.node_id, near, name)


def setup(app):
    app.add_directive("names", Names)
    app.add_directive("commands", Commands)
    app.connect("missing-reference", by_last_part)
    return {"parallel_read_safe": True}
