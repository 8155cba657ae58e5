"""C code in lanes of what is made of several functions: MX graphs, maps, Newton iterations.

An MX function moves blocks of numbers, looks up cells of tables (each lane its own), and calls
other functions.  Of solvers there is ``fast_newton`` as this package uses it, a loop around a step,
with a mask: lanes that have converged stay as they are while others go on.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np

from apu_casadi.core.lanes.lanecode import BINARY, UNARY, Fixed, NoForm, Writer, number, refused

_MOVES = {ca.OP_RESHAPE, ca.OP_SPARSITY_CAST, ca.OP_TRANSPOSE, ca.OP_PROJECT, ca.OP_GETNONZEROS}
_MOVES |= {ca.OP_HORZREPMAT}
COLUMNS = 4  # of a product that are summed at once
_JOINS = {ca.OP_HORZCAT, ca.OP_VERTCAT, ca.OP_DIAGCAT}
_SPLITS = {ca.OP_HORZSPLIT, ca.OP_VERTSPLIT}
_SETS = {ca.OP_SETNONZEROS: "=", ca.OP_ADDNONZEROS: "+="}
# {x}, {y}: operands, {n}: their entries; the sum or the like is s
_SUMS = {
    ca.OP_NORM1: ("0.0", "s=s+{p}fabs({x}[k])", "s"),
    ca.OP_NORMF: ("0.0", "s=s+{x}[k]*{x}[k]", "{p}sqrt(s)"),
    ca.OP_NORM2: ("0.0", "s=s+{x}[k]*{x}[k]", "{p}sqrt(s)"),
    ca.OP_NORMINF: ("0.0", "s={p}fmax(s,{p}fabs({x}[k]))", "s"),
    ca.OP_MMAX: ("{edge}", "s={p}fmax(s,{x}[k])", "s"),
    ca.OP_MMIN: ("-({edge})", "s={p}fmin(s,{x}[k])", "s"),
    ca.OP_DOT: ("0.0", "s=s+{x}[k]*{y}[k]", "s"),
}


def graph_writer(lanes: int) -> Writer:
    """Return a writer of all kinds of functions that have a form in lanes."""
    writer = Writer(lanes)
    writer.add("MXFunction", lambda *given: _Graph(*given[:3]).write())
    writer.add("Map", _mapped)
    writer.add("FastNewton", _newton)
    return writer


def _indices(info: dict[str, Any]) -> list[int]:
    """Return the nonzeros that an instruction takes or sets, in order."""
    if "nz" in info:
        return [int(i) for i in info["nz"]]

    def along(s: dict[str, int]) -> range:
        return range(s["start"], s["stop"], s["step"])

    if "slice" in info:
        return [*along(info["slice"])]
    return [i + j for i in along(info["outer"]) for j in along(info["inner"])]


def _positions(sparsity: ca.Sparsity) -> ca.DM:
    return ca.DM(sparsity, np.arange(1.0, sparsity.nnz() + 1))


class _Places:
    """Where each work vector of a graph stands while something still reads it.

    The first place that is free, from the front: what is used stays near, in the cache.  CasADi's
    own numbers of work vectors are kept apart: a graph reuses few of them.

    Args:
        graph: the function; its instructions are come to one after the other.
    """

    def __init__(self, graph: _Graph) -> None:
        self.most = 0  # work in all
        self._at: dict[int, int] = {}  # where a vector stands, by CasADi's number of it
        self._taken: dict[int, tuple[int, int]] = {}  # first: (end, last instruction that reads)
        self._need: dict[int, tuple[int, int]] = {}  # by number: size, last instruction
        last: dict[int, int] = {}
        #: by instruction and number of a vector that is made there: its size, its last instruction
        self._made: dict[int, dict[int, tuple[int, int]]] = {}
        size: dict[int, int] = {}
        for k in range(graph.n - 1, -1, -1):
            self._made[k] = {}
            outs = () if graph.op[k] == ca.OP_OUTPUT else graph.outs[k]
            ins = () if graph.op[k] == ca.OP_INPUT else graph.ins[k]
            for i, n in zip(outs, graph.sizes(k) if outs else (), strict=True):
                size[i] = max(n, size.get(i, 0))
                if i >= 0 and i not in ins:  # else it goes on in its place
                    self._made[k][i] = size.pop(i), last.pop(i, k)
            for i in ins:
                last.setdefault(i, k)

    def come_to(self, k: int) -> None:
        """Free what no instruction from ``k`` on reads; what it makes has no place yet."""
        self._taken = {at: v for at, v in self._taken.items() if v[1] >= k}
        for i, need in self._made[k].items():
            self._at.pop(i, None)
            self._need[i] = need

    def of(self, i: int) -> int:
        """Return where a vector stands; it is given a place if it has none."""
        if i not in self._at:
            n, last = self._need[i]
            at = 0
            for first in sorted(self._taken):
                if first >= at + n:
                    break
                at = max(at, self._taken[first][0])
            self._at[i] = at
            if n:
                self._taken[at] = at + n, last
            self.most = max(self.most, at + n)
        return self._at[i]


class _Graph:
    """Writes one MX function; work vectors stand in w where none that is still read stands."""

    def __init__(self, writer: Writer, fun: ca.Function, name: str) -> None:
        self.writer, self.fun, self.name = writer, fun, name
        self.p, self.T = "v_", "V"
        self.n = fun.n_instructions()
        self.nodes = [fun.instruction_MX(k) for k in range(self.n)]
        self.op = [fun.instruction_id(k) for k in range(self.n)]
        self.ins = [fun.instruction_input(k) for k in range(self.n)]
        self.outs = [fun.instruction_output(k) for k in range(self.n)]
        self.body: list[str] = []
        self.inner = 0  # largest work of what is called
        self.scratch = 0  # of outputs that nobody wants, inputs that are not there, copies
        #: instructions whose one column maps take again and again
        self.repeated = {
            k for k in range(self.n) if self.op[k] == ca.OP_HORZREPMAT and self._for_maps(k)
        }
        self.place = _Places(self)
        self.alias: dict[int, str] = {}  # work that is a part of an input
        self.tables: dict[int, str] = {}  # work that is a constant table

    def sizes(self, k: int) -> list[int]:
        """Nonzeros of the outputs of an instruction; of the one column that is repeated."""
        node = self.nodes[k]
        if k in self.repeated:
            return [node.dep(0).nnz()]
        if self.op[k] == ca.OP_CALL:
            g = node.which_function()
            return [g.nnz_out(j) for j in range(g.n_out())]
        if self.op[k] in _SPLITS:
            parts = node.info()["output"]
            return [parts.nnz_out(j) for j in range(parts.n_out())]
        return [node.nnz()]

    def _for_maps(self, k: int) -> bool:
        """Whether a column that is repeated goes to maps of as many columns, and nowhere else."""
        node, o = self.nodes[k], self.outs[k][0]
        times = node.nnz() // max(1, node.dep(0).nnz())
        used = False
        for later in range(k + 1, self.n):
            if o in self.ins[later]:
                g = self.nodes[later].which_function() if self.op[later] == ca.OP_CALL else None
                if g is None or g.class_name() != "Map" or map_of(g)[1] != times:
                    return False
                used = True
            if o in self.outs[later] and self.op[later] != ca.OP_OUTPUT:
                break
        return used

    def write(self) -> int:
        for k in range(self.n):
            self.place.come_to(k)
            self._instruction(k)
        T, own = self.T, self.place.most
        head = f"static void {self.name}(const {T}*const*a,{T}*const*r,{T}*w){{"
        more = f"{T}*const x=w+{own};(void)x;"  # scratch, then the work of what is called
        body = [line.replace("SCRATCH", str(self.scratch)) for line in self.body]
        self.writer.put("\n".join([head, more, *body, "}"]))
        return own + self.scratch + self.inner

    def _w(self, i: int) -> str:
        """Where work is; a part of scratch that holds zeros if there is none."""
        return f"(w+{self.place.of(i)})" if i >= 0 else "x"

    def _get(self, i: int) -> str:
        """Where work is read: a part of an input itself, as long as that is all it is."""
        return self.alias[i] if i in self.alias else self._w(i)

    def _stands(self, k: int) -> str:
        """Where the output of an instruction stands already, in an input; "" if it does not."""
        op, node = self.op[k], self.nodes[k]
        if op == ca.OP_INPUT:
            info = node.info()
            return f"(a[{info['ind']}]+{info['offset']})"
        if op in _MOVES and self.ins[k][0] in self.alias and k not in self.repeated:
            which = self._from(k)
            if which and which == [*range(which[0], which[0] + len(which))]:
                return f"({self.alias[self.ins[k][0]]}+{which[0]})"
        return ""

    def _each(self, n: int, statement: str) -> None:
        self.body.append(f"for(int k=0;k<{n};k++){statement};" if n else ";")

    def _room(self, n: int) -> None:
        self.scratch = max(self.scratch, n)

    def _instruction(self, k: int) -> None:
        op, o = self.op[k], self.outs[k]
        here = self._stands(k)
        fresh = {o[0]: here} if here else self._split(k)
        if not fresh:
            self._written(k)
        if op != ca.OP_OUTPUT:
            for j in o:
                self.alias.pop(j, None)
            self.alias |= fresh

    def _split(self, k: int) -> dict[int, str]:
        """Parts of an input, which stand where they are."""
        if self.op[k] not in _SPLITS or self.ins[k][0] not in self.alias:
            return {}
        at, found = 0, {}
        for target, n in zip(self.outs[k], self.sizes(k), strict=True):
            found[target] = f"({self.alias[self.ins[k][0]]}+{at})"
            at += n
        found.pop(-1, None)
        return found

    def _written(self, k: int) -> None:
        op, node, i, o = self.op[k], self.nodes[k], self.ins[k], self.outs[k]
        if op == ca.OP_OUTPUT:
            info = node.info()
            n = node.dep(0).nnz()
            self._each(n, f"r[{info['ind']}][{info['offset']}+k]={self._get(i[0])}[k]")
        elif op == ca.OP_CONST:
            self._constant(k)
        elif op in UNARY or op in BINARY:
            self._elementwise(k)
        elif k in self.repeated:
            n = node.dep(0).nnz()
            self._each(n, f"{self._w(o[0])}[k]={self._get(i[0])}[k]")
        elif op in _MOVES:
            self._move(self._w(o[0]), self._get(i[0]), self._from(k))
        elif op in _JOINS:
            at = 0
            for j, source in enumerate(i):
                n = node.dep(j).nnz()
                self._each(n, f"{self._w(o[0])}[{at}+k]={self._get(source)}[k]")
                at += n
        elif op in _SPLITS:
            at = 0
            for target, n in zip(o, self.sizes(k), strict=True):
                if target >= 0:
                    self._each(n, f"{self._w(target)}[k]={self._get(i[0])}[{at}+k]")
                at += n
        elif op in _SETS:
            self._set(k)
        elif op in _SUMS:
            self._sum(k)
        elif op == ca.OP_MTIMES:
            self._product(k)
        elif op == ca.OP_LOW:
            self._low(k)
        elif op == ca.OP_GETNONZEROS_PARAM:
            self._gather(k)
        elif op == ca.OP_CALL:
            self._call(k)
        else:
            raise refused(self.fun, op)

    # -------------------------------------------------------------------------- moves

    def _constant(self, k: int) -> None:
        values = self.nodes[k].to_DM().nonzeros()
        i = self.outs[k][0]
        self.tables[k] = table = self.writer.table("double", [number(v) for v in values])
        looked_up = (ca.OP_LOW, ca.OP_GETNONZEROS_PARAM)
        for later in range(k + 1, self.n):
            if self.op[later] != ca.OP_INPUT and (
                i in self.ins[later][1:]
                or (i in self.ins[later][:1] and self.op[later] not in looked_up)
            ):
                self._each(len(values), f"{self._w(i)}[k]={self.p}all({table}[k])")
                return
            if i in self.outs[later] and self.op[later] != ca.OP_OUTPUT:
                return

    def _made_by(self, k: int, i: int) -> int:
        """Return which instruction before another one made a work vector; -1: none."""
        for before in range(k - 1, -1, -1):
            if i >= 0 and self.op[before] != ca.OP_OUTPUT and i in self.outs[before]:
                return before
        return -1

    def _table_of(self, k: int) -> str | None:
        """Return the table that the first input of an instruction is; None where it varies."""
        return self.tables.get(self._made_by(k, self.ins[k][0]))

    def _elementwise(self, k: int) -> None:
        op, node, n = self.op[k], self.nodes[k], self.nodes[k].nnz()
        terms = []
        for j, i in enumerate(self.ins[k]):
            one = node.dep(j).nnz() == 1 and n != 1
            terms.append(f"{self._get(i)}[0]" if one else f"{self._get(i)}[k]")
        code = BINARY[op] if op in BINARY else UNARY[op]
        code = code.format(p=self.p, a=terms[0], b=terms[-1])
        self._each(n, f"{self._w(self.outs[k][0])}[k]={code}")

    def _from(self, k: int) -> list[int]:
        """Return which nonzero of the first input each of the output is; -1: none, 0."""
        op, node = self.op[k], self.nodes[k]
        if op == ca.OP_GETNONZEROS:
            return _indices(node.info())
        x = node.dep(0).sparsity()
        if op == ca.OP_HORZREPMAT:
            return [*range(x.nnz())] * (node.nnz() // max(1, x.nnz()))
        at = _positions(x)
        if op == ca.OP_TRANSPOSE:
            at = at.T
        elif op == ca.OP_PROJECT:
            at = ca.project(at, node.sparsity())
        return [int(v) - 1 for v in at.nonzeros()]

    def _move(self, to: str, source: str, which: Sequence[int], how: str = "=") -> None:
        """Copy chosen entries of a vector; by way of scratch where it stays in place."""
        if to == source:
            if [*which] == [*range(len(which))]:
                return
            size = max(which, default=-1) + 1
            self._room(size)
            self._each(size, f"x[k]={source}[k]")
            source = "x"
        self._each(len(which), f"{to}[k]{how}{self._picked(source, which)}")

    def _picked(self, source: str, which: Sequence[int]) -> str:
        at = self._at(which)
        if min(which, default=0) < 0:
            return f"{at}<0?{self.p}all(0.0):{source}[{at}]"
        return f"{source}[{at}]"

    def _at(self, which: Sequence[int]) -> str:
        """Index of entry k of a list, in C."""
        steps = set(np.diff(which).tolist()) if len(which) > 1 else {1}
        if len(steps) == 1 and min(which, default=0) >= 0:
            return f"{which[0] if which else 0}+k*{steps.pop()}"
        return f"{self.writer.table('int', [*map(str, which)])}[k]"

    def _set(self, k: int) -> None:
        (base, values), to = self.ins[k], self._w(self.outs[k][0])
        which, how = _indices(self.nodes[k].info()), _SETS[self.op[k]]
        if self._get(base) != to:
            self._each(self.nodes[k].nnz(), f"{to}[k]={self._get(base)}[k]")
        kept = [j for j, at in enumerate(which) if at >= 0]
        source, target = self._at(kept), self._at([which[j] for j in kept])
        self._each(len(kept), f"{to}[{target}]{how}{self._get(values)}[{source}]")

    # -------------------------------------------------------------------------- sums

    def _sum(self, k: int) -> None:
        node, i = self.nodes[k], self.ins[k]
        x = node.dep(0)
        edge = "-INFINITY" if x.is_dense() else "0.0"
        given = {"p": self.p, "x": self._get(i[0]), "y": self._get(i[-1]), "edge": edge}
        start, add, end = (text.format(**given) for text in _SUMS[self.op[k]])
        to = self._w(self.outs[k][0])
        loop = f"for(int k=0;k<{x.nnz()};k++){add};"
        self.body.append(f"{{{self.T} s={self.p}all({start});{loop}{to}[0]={end};}}")

    def _product(self, k: int) -> None:
        """z + x y; each entry summed in the order of the inner index."""
        node, (_, ix, iy), to = self.nodes[k], self.ins[k], self._w(self.outs[k][0])
        z, x, y = (node.dep(j).sparsity() for j in range(3))
        if self._get(self.ins[k][0]) != to:
            self._each(z.nnz(), f"{to}[k]={self._get(self.ins[k][0])}[k]")
        X, Y = self._get(ix), self._get(iy)
        if x.is_dense() and y.is_dense() and z.is_dense():
            self._dense(to, X, Y, (*x.shape, y.shape[1]))
            return
        rows: list[tuple[int, int, int]] = []
        x_at, y_at, z_at = (np.array(_positions(s).full(), int) - 1 for s in (x, y, z))
        for j in range(y.shape[1]):
            for r in y.row()[y.colind()[j] : y.colind()[j + 1]]:
                for i in x.row()[x.colind()[r] : x.colind()[r + 1]]:
                    if z_at[i, j] >= 0:
                        rows.append((z_at[i, j], x_at[i, r], y_at[r, j]))
        a, b, c = (self._at([int(row[q]) for row in rows]) for q in range(3))
        self._each(len(rows), f"{to}[{a}]={to}[{a}]+{X}[{b}]*{Y}[{c}]")

    def _dense(self, to: str, X: str, Y: str, sizes: tuple[int, ...]) -> None:
        """Dense z + x y, some columns at once: what is read of x serves all of them."""
        (n, m, q), at, T = sizes, 0, self.T
        for width in (COLUMNS, 1):
            end, each = at + (q - at) // width * width, range(width)
            if end > at:
                first = ",".join(f"s{c}={to}[j+(i+{c})*{n}]" for c in each)
                add = "".join(f"s{c}=s{c}+b*{Y}[k+(i+{c})*{m}];" for c in each)
                last = "".join(f"{to}[j+(i+{c})*{n}]=s{c};" for c in each)
                self.body.append(
                    f"for(int i={at};i<{end};i+={width})for(int j=0;j<{n};j++){{{T} {first};"
                    f"for(int k=0;k<{m};k++){{const {T} b={X}[j+k*{n}];{add}}}{last}}}"
                )
            at = end

    # -------------------------------------------------------------------------- tables

    def _low(self, k: int) -> None:
        """The interval of a table that a number is in, sought as CasADi's C does."""
        table, node = self._table_of(k), self.nodes[k]
        mode = _low_modes(self.fun)[self.op[:k].count(ca.OP_LOW)]
        if table is None or mode == 1:
            what = "a grid that is computed" if table is None else "lookup_mode exact"
            raise NoForm(f"{self.fun.name()}: LOW with {what} has no form in lanes")
        n = node.dep(0).nnz()
        to, x = self._w(self.outs[k][0]), self._get(self.ins[k][1])
        # intervals begun, one after the other: what is not a number counts as beyond them all
        count = f"for(int g=1;g<{n}-1;g++)s=s+{self.p}sel(b<{table}[g],zero,one);"
        ones = f"const {self.T} zero={self.p}all(0.0),one={self.p}all(1.0);"
        loop = f"{self.T} s=zero,b={x}[k];{count}{to}[k]=s;"
        self.body.append(f"{{{ones}for(int k=0;k<{node.nnz()};k++){{{loop}}}}}")

    def _gather(self, k: int) -> None:
        """Entries of a vector at places that are computed, each lane's own."""
        node, info = self.nodes[k], self.nodes[k].info()
        to, at = self._w(self.outs[k][0]), self._get(self.ins[k][1])
        if "inner" not in info or node.dep(1).nnz() != 1:
            raise NoForm(
                f"{self.fun.name()}: the operation GETNONZEROS_PARAM has a form in lanes only "
                "where one number tells the place of a slice"
            )
        s, table = info["inner"], self._table_of(k)
        which = f"({s['start']}+k*{s['step']})"
        n = node.nnz()
        if table and s["step"] == 1:
            self.body.append(f"{self.p}rows({table}+{s['start']},{at}[0],{n},{to});")
            return
        source = f"{table}[q+{which}]" if table else f"{self._get(self.ins[k][0])}[q+{which}][l]"
        self._room(1)
        self.body.append(
            f"x[0]={at}[0];for(int l=0;l<L;l++){{const int q=(int)x[0][l];double*t=(double*){to}+l;"
            f"for(int k=0;k<{n};k++)t[k*L]={source};}}"
        )

    # -------------------------------------------------------------------------- calls

    def _call(self, k: int) -> None:
        g, T = self.nodes[k].which_function(), self.T
        made = [self._made_by(k, i) for i in self.ins[k]]
        fixed = tuple(j for j, by in enumerate(made) if by in self.repeated)
        done = self.writer.function(g, fixed)
        unwanted = sum(g.nnz_out(j) for j, o in enumerate(self.outs[k]) if o < 0)
        absent = max((g.nnz_in(j) for j, i in enumerate(self.ins[k]) if i < 0), default=0)
        self._room(absent + unwanted)
        self.inner = max(self.inner, done.work)
        if absent:
            self._each(absent, f"x[k]={self.p}all(0.0)")
        args = ",".join(self._get(i) for i in self.ins[k]) or "x"
        at, results = absent, []
        for j, o in enumerate(self.outs[k]):
            results.append(self._w(o) if o >= 0 else f"x+{at}")
            at += 0 if o >= 0 else g.nnz_out(j)
        self.body.append(
            f"{{const {T}*const a1[]={{{args}}};{T}*const r1[]={{{','.join(results) or 'x'}}};"
            f"{done.name}(a1,r1,x+SCRATCH);}}"
        )


def _low_modes(fun: ca.Function) -> list[int]:
    """Return how each search of an MX function goes, from the C that CasADi writes for it."""
    body = _own_code(fun)
    return [int(m) for m in re.findall(r"casadi_low\([^;]*, \d+, (\d+)\)", body)]


def _own_code(fun: ca.Function) -> str:
    """Return CasADi's C of a function, without that of what it calls."""
    generator = ca.CodeGenerator("code.c", {"with_header": False, "verbose": False})
    generator.add(fun)
    text: str = generator.dump()
    return text[text.index("static int casadi_f0(") :]


def map_of(fun: ca.Function) -> tuple[ca.Function, int]:
    """Return what a map evaluates, and for how many columns."""
    (inner,) = (fun.get_function(n) for n in fun.get_function())
    some = (j for j in range(fun.n_out()) if inner.nnz_out(j))
    return inner, next((fun.nnz_out(j) // inner.nnz_out(j) for j in some), 0)


def _mapped(writer: Writer, fun: ca.Function, name: str, fixed: Fixed) -> int:
    """Write a map, column by column."""
    inner, count = map_of(fun)
    done = writer.function(inner)
    steps = [0 if i in fixed else inner.nnz_in(i) for i in range(inner.n_in())]
    args = ",".join(f"a[{i}]+c*{n}" for i, n in enumerate(steps)) or "0"
    results = ",".join(f"r[{j}]+c*{inner.nnz_out(j)}" for j in range(inner.n_out()))
    writer.put(
        f"static void {name}(const V*const*a,V*const*r,V*w){{\n"
        f"for(int c=0;c<{count};c++){{const V*const a1[]={{{args}}};V*const r1[]={{{results}}};"
        f"{done.name}(a1,r1,w);}}}}"
    )
    return done.work


_NEWTON = """
static void NAME(const V*const*a,V*const*r,V*w){
V*const x=w,*const g=w+N,*const J=w+2*N;
for(int k=0;k<N;k++)x[k]=a[0][k];
M on=~(M){0};
for(int i=0;i<ITER;i++){
const V*const a1[]={ARGS};V*const r1[]={J,g};
LOOP(a1,r1,J+NNZ);
V s=v_all(0.0);
if(ABSTOL>0){for(int k=0;k<N;k++)s=v_fmax(s,v_fabs(g[k]));on=on&~(s<=ABSTOL);}
if(!v_any(on))break;
/* the division by a Jacobian of ones is CasADi's, which makes NaN of what is infinite */
for(int k=0;k<N;k++){g[k]=g[k]-(0.0+g[k])*0.0;x[k]=v_sel(on,x[k]+-1.0*g[k],x[k]);}
s=v_all(0.0);
if(STEP>0){for(int k=0;k<N;k++)s=v_fmax(s,v_fabs(g[k]));on=on&~(s<=STEP);}
if(!v_any(on))break;
}
for(int k=0;k<N;k++)r[0][k]=x[k];
}"""


def _newton(writer: Writer, fun: ca.Function, name: str, _: Fixed) -> int:
    """Write the loop around a step; what has converged in a lane stays as it is."""
    loop = fun.get_function("jac_g_x")
    n: int = fun.nnz_in(0)
    code = _own_code(fun)
    if fun.n_out() != 1 or loop.nnz_out(0) != n or not _is_identity(loop):
        raise NoForm(
            f"{fun.name()}: fast_newton has a form in lanes only where its Jacobian is the "
            "identity: let the function be Newton's step itself (jacobian_function)"
        )
    done = writer.function(loop)
    found = {
        key: re.search(pattern, code)
        for key, pattern in (
            ("ABSTOL", r"m\.abstol = ([^;]+);"),
            ("STEP", r"m\.abstol_step = ([^;]+);"),
            ("ITER", r"iter<(\d+);"),
        )
    }
    values = {k: m.group(1) for k, m in found.items() if m}
    if len(values) < len(found):
        raise NoForm(f"{fun.name()}: CasADi's code for fast_newton is not what is expected")
    args = ",".join(["x", *(f"a[{i}]" for i in range(1, fun.n_in()))])
    text = _NEWTON
    words = {"NAME": name, "ARGS": args, "LOOP": done.name, "NNZ": str(n), "N": str(n)}
    for key, value in (words | values).items():
        text = re.sub(rf"\b{key}\b", value, text)
    writer.put(text)
    return 3 * n + done.work


def _is_identity(loop: ca.Function) -> bool:
    """Whether the first output of an MX function is the constant identity."""
    if loop.class_name() != "MXFunction":
        return False
    made: dict[int, Any] = {}
    for k in range(loop.n_instructions()):
        node = loop.instruction_MX(k)
        if loop.instruction_id(k) == ca.OP_OUTPUT:
            if node.info()["ind"] == 0:
                source = made.get(loop.instruction_input(k)[0])
                return source is not None and bool(source.is_constant() and source.is_eye())
        else:
            made |= dict.fromkeys(loop.instruction_output(k), node)
    return False
