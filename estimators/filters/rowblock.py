"""A block of EKF steps of one filter, compiled with the rows of its matrices in vector lanes.

Written out in scalar operations, a step of twenty states is one part model and three parts algebra
of covariances.  Here the model stays scalar code; the algebra goes by columns, as many rows at once
as there are lanes:

    B = L^-1 H P,   d = B' a,   X = F P,   P1 = X F' + W W' - G (G + D)' - D G' + Q dt,

with S = L L' = H P H' + R, W the columns of F that belong to noise, G = F_f B_f' of the columns
that have a gain and D = F_c B_c' of considered states: the equations of
:func:`estimators.filters.ekf.ekf_step`.  Every entry is summed in the order of that function's
graph, without fused multiply-add, so results are those of the scalar block to the last bit.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import casadi as ca

from apu_casadi.core.backend import Code
from apu_casadi.core.lanes.lanecode import Writer, number
from apu_casadi.core.lanes.lanelibrary import digest, flags_of, framed
from apu_casadi.core.reciprocals import as_written, by_reciprocals
from apu_casadi.core.sharing import derived, once

__all__ = ["SOME", "Rows", "row_block"]


@dataclass(frozen=True, eq=False)
class Rows:
    """A step in parts: of a model in scalar operations that has no bounds.

    Args:
        symbols: m, at (the corrected state with its noise), u, p, y, R, dt.
        read: innovation, H, variances, innovation as told, check, number measured.
        forecast: next mean, F, check.
        gain: Function (H, P H', variances, innovation, measured) -> (L, inverses of its diagonal,
            L^-1 nu, diagonal of S, nis and log-likelihood and measured).
        fixed: considered states.
        walk: variances of the random walks in a second.
    """

    symbols: tuple[ca.SX, ...]
    read: tuple[ca.SX, ...]
    forecast: tuple[ca.SX, ...]
    gain: ca.Function
    fixed: tuple[int, ...]
    walk: tuple[float, ...]

    def functions(self, name: str) -> tuple[ca.Function, ca.Function, ca.Function]:
        """Return what hangs on p alone, and both parts of the model with it below p."""
        s, n = [*self.symbols], len(self.read)
        out, symbols, constant = ca.extract_parametric(ca.cse([*self.read, *self.forecast]), s[3])
        of_p = ca.Function(f"{name}_constants", [s[3]], [ca.vertcat(*constant)])
        s[3] = ca.vertcat(s[3], *symbols)
        # quotients of both are counted together, as in the step that is one function
        both = by_reciprocals(ca.Function(f"{name}_model", s, out))
        s = both.sx_in()
        with as_written():
            out = both.call(s)
        read = ca.Function(f"{name}_read", s, out[:n])
        return of_p, read, ca.Function(f"{name}_forecast", s, out[n:])


_TYPES = """
#define ALL(x) v_all(x)
#define ROW(A,i) ((double*)(A)+(i)*NV*L)
IN void turned(const V*from,V*to){
#ifdef TURNED
int i[L];for(int l=0;l<L;l++)i[l]=l*NV*L;
v_turned((const double*)from,i,to);
#else
for(int l=0;l<L;l++)for(int k=0;k<L;k++)((double*)to)[k*L+l]=((const double*)from)[l*NV*L+k];
#endif
}
/* the upper triangle from the lower one */
static void mirrored(V*A){V t[L];
for(int b=0;b<NV;b++){
turned(A+b*L*NV+b,t);
for(int k=0;k<L;k++)A[(b*L+k)*NV+b]=v_sel(((const M*)below)[k],A[(b*L+k)*NV+b],t[k]);
for(int c=b+1;c<NV;c++){turned(A+c*L*NV+b,t);for(int k=0;k<L;k++)A[(b*L+k)*NV+c]=t[k];}}}
"""

_BEFORE = """
double hp[NX*NY],m[NX],m1[NX],at[NX+NW],Hz[NH],Fz[NF+1],Rd[NY],nu[NY],a[NY],inv[NY],Lz[NY*NY];
double pc[NP+NC],check,measured,work[WORK];
V P[NV*L*NV],X[NX*NV],F[(NX+NW)*NV],HP[NY*MV],B[NY*MV],d[MV],G[NY*NV],D[NY*NV],E[NY*NV];
memset(P,0,sizeof P);memset(F,0,sizeof F);memset(HP,0,sizeof HP);memset(B,0,sizeof B);
for(int k=0;k<NP;k++)pc[k]=arg[8][k];
TO_SCALAR {const double*a1[]={arg[8]};double*r1[]={pc+NP};CONSTANTS(a1,r1,0,work,0);}
for(int i=0;i<NX;i++){m[i]=arg[0][i];for(int j=0;j<=i;j++)ROW(P,i)[j]=arg[1][j*NX+i];}
mirrored(P);
for(int k=0;k<NCONST;k++)((double*)F)[const_to[k]]=const_of[k];
"""
_READ = """
memcpy(res[2],arg[2],sizeof(double)*NX*NX);
double*to=res[8];
for(int s=0;s<K;s++){
const double*us=arg[3]+s*NU,*ys=arg[4]+s*NY,*Rs=arg[5]+s*NY,*dts=arg[6]+s;
if(Rs[0]==PADDED)break;
double*stats=res[7]+4*s;
TO_SCALAR {const double*a1[]={m,at,us,pc,ys,Rs,dts};
double*r1[]={nu,Hz,Rd,res[5]+s*NY,&check,&measured};READ(a1,r1,0,work,0);}
/* H P as columns; below the states the noise */
"""
_GAIN = """
for(int l=0;l<NY;l++)for(int i=0;i<NX;i++)hp[l*NX+i]=((double*)(HP+l*MV))[i];
TO_SCALAR {const double*a1[]={Hz,hp,Rd,nu,&measured};
double*r1[]={Lz,inv,a,res[6]+s*NY,stats+1};GAIN(a1,r1,0,work,0);}
for(int v=0;v<MV;v++){
"""
_FORECAST = """
}
for(int i=0;i<NX;i++)res[3][s*NX+i]=at[i]=gains[i]?m[i]+((double*)d)[i]:m[i];
for(int i=0;i<NW;i++)at[NX+i]=((double*)(d+NV))[i];
TO_SCALAR {const double*a1[]={m,at,us,pc,ys,Rs,dts};
double*r1[]={m1,Fz,stats};FORECAST(a1,r1,0,work,0);}
stats[0]=check+stats[0];
for(int k=0;k<NF;k++)((double*)F)[f_to[k]]=Fz[k];
"""
_FILTERED = """
for(int i=0;i<NX;i++){double t=0.0;
for(int k=0;k<NY;k++){const double b=((double*)(B+k*MV))[i];t=t+b*b;}
res[4][s*NX+i]=ROW(P,i)[i]-t*gains[i];}
if(arg[7][s]!=0.0&&to+HALF<=res[8]+SOME*HALF){
for(int j=0;j<NX;j++){const double*b=(double*)B+j;
for(int i=0;i<NX-j;i++){double t=b[i]*b[0];
for(int k=1;k<NY;k++)t=t+b[k*MV*L+i]*b[k*MV*L];
to[i]=ROW(P,j)[j+i]-(gains[j]+gains[j+i]>0.0?t:0.0);}
to+=NX-j;}}
if(s==K-1||Rs[NY]==PADDED)
for(int i=0;i<NX;i++)for(int j=0;j<=i;j++){double t=0.0;
for(int k=0;k<NY;k++)t=t+((double*)(B+k*MV))[i]*((double*)(B+k*MV))[j];
res[2][i*NX+j]=res[2][j*NX+i]=ROW(P,i)[j]-(gains[i]+gains[j]>0.0?t:0.0);}
"""
_AFTER = """
mirrored(P);
for(int i=0;i<NX;i++)m[i]=m1[i];
}
for(int i=0;i<NX;i++){res[0][i]=m[i];for(int j=0;j<NX;j++)res[1][i*NX+j]=ROW(P,i)[j];}
TO_SCALAR return 0;}
"""
SOME = 8  # samples of a block whose covariances are kept
INPUTS = ["m", "P", "P_last", "u", "y", "R", "dt", "keep", "p"]
OUTPUTS = ["m1", "P1", "P_f", "m_f", "var", "nu", "S", "stats", "some"]
WOVEN = 8  # sums that are under way at once: an addition takes four cycles, and two begin in each

Terms = Sequence[tuple[str, str]]  # a number and a vector


def _woven(sums: Sequence[tuple[str, Sequence[Terms]]]) -> Iterator[str]:
    """Write sums of products side by side; ``{}`` in a target's text are its sums."""
    for k in range(0, len(sums), WOVEN):
        some = [*enumerate(sums[k : k + WOVEN])]
        parts = {f"t{q}_{r}": terms for q, (_, own) in some for r, terms in enumerate(own)}
        yield "{V " + ",".join(parts) + ";"
        for r in range(max(map(len, parts.values()), default=0)):
            for name, terms in parts.items():
                if r < len(terms):
                    product = "ALL({})*{}".format(*terms[r])
                    yield f"{name}={product};" if not r else f"{name}={name}+{product};"
        for q, (text, own) in some:
            shown = [f"t{q}_{r}" if terms else "ALL(0.0)" for r, terms in enumerate(own)]
            yield text.format(*shown)
        yield "}"


@dataclass(frozen=True, eq=False)
class _Layout:
    """Where entries of H and F stand, and the code of sums of their products."""

    nx: int
    ny: int
    lanes: int
    fixed: tuple[int, ...]
    walk: tuple[float, ...]
    H: ca.Sparsity
    F: ca.SX

    @property
    def room(self) -> int:
        """Vectors of a column of states."""
        return -(-self.nx // self.lanes)

    @derived
    def entries(self) -> list[tuple[int, int, ca.SX]]:
        """Of F: row, column and expression."""
        return [*zip(*self.F.sparsity().get_triplet(), self.F.nonzeros(), strict=True)]

    @derived
    def varying(self) -> list[tuple[int, int, ca.SX]]:
        """Those that are no constants."""
        return [e for e in self.entries if not e[2].is_constant()]

    @derived
    def rows(self) -> list[list[int]]:
        """Columns of states that each row has entries in."""
        return [[j for i, j, _ in self.entries if i == r and j < self.nx] for r in range(self.nx)]

    @derived
    def unit(self) -> list[int]:
        """The one state that is the row, as far as states go; -1: another row."""
        ones = {(i, j) for i, j, e in self.entries if e.is_constant() and float(e) == 1.0}
        return [r[0] if len(r) == 1 and (i, r[0]) in ones else -1 for i, r in enumerate(self.rows)]

    def at(self, i: int) -> int:
        """Where a state, or a noise below the states, stands in a column."""
        return i if i < self.nx else self.room * self.lanes + i - self.nx

    def number(self, name: str, column: int, row: int, *, tall: bool = False) -> str:
        """One entry of a matrix of columns, ``tall`` with the noise below."""
        return f"((double*)({name}+{column}*{'MV' if tall else 'NV'}))[{row}]"

    def filled(self, v: int) -> list[int]:
        """Columns of F that have entries in a block of rows."""
        block = range(v * self.lanes, (v + 1) * self.lanes)
        return sorted({j for i, j, _ in self.entries if i in block})

    def tables(self) -> list[str]:
        """Where the entries of F go."""
        tall = self.room * self.lanes
        stay = [(i, j, float(e)) for i, j, e in self.entries if e.is_constant()]
        return [
            _ints("f_to", [j * tall + i for i, j, _ in self.varying]),
            _ints("const_to", [j * tall + i for i, j, _ in stay]),
            _doubles("const_of", [value for _, _, value in stay]),
        ]

    def output(self) -> Iterator[str]:
        """H P' and, below it, what noise H has."""
        own: list[list[tuple[int, int]]] = [[] for _ in range(self.ny)]
        for z, (i, j) in enumerate(zip(*self.H.get_triplet(), strict=True)):
            if j >= self.nx:
                yield f"{self.number('HP', i, self.at(j), tall=True)}=Hz[{z}];"
            else:
                own[i].append((j, z))
        for v in range(self.room):
            sums = [[(f"Hz[{z}]", f"P[{j}*NV+{v}]") for j, z in line] for line in own]
            yield from _woven([(f"HP[{i}*MV+{v}]={{}};", [s]) for i, s in enumerate(sums)])

    def gained(self) -> Iterator[str]:
        """B and the change of the mean, of one vector v."""
        for i in range(self.ny):
            yield f"V b{i}=HP[{i}*MV+v];"
            yield from (f"b{i}=b{i}-ALL(Lz[{i + k * self.ny}])*b{k};" for k in range(i))
            yield f"b{i}=b{i}*ALL(inv[{i}]);B[{i}*MV+v]=b{i};"
        yield f"d[v]={'+'.join(f'b{i}*ALL(a[{i}])' for i in range(self.ny))};"

    def ahead(self) -> Iterator[str]:
        """X = F P by rows, and the columns of G, D and G + D = E."""
        for i, j in enumerate(self.unit):
            if j >= 0:
                yield f"for(int v=0;v<NV;v++)X[{i}*NV+v]=P[{j}*NV+v];"
        for v in range(self.room):
            sums = []
            for i, row in enumerate(self.rows):
                terms = [(self.number("F", j, i), f"P[{j}*NV+{v}]") for j in row]
                sums += [(f"X[{i}*NV+{v}]={{}};", [terms])] if self.unit[i] < 0 else []
            yield from _woven(sums)
        for v in range(self.room):
            sums = []
            for k in range(self.ny):
                both: tuple[list[tuple[str, str]], ...] = ([], [])
                for j in self.filled(v):
                    number_of_b = self.number("B", k, self.at(j), tall=True)
                    both[j in self.fixed].append((number_of_b, f"F[{j}*NV+{v}]"))
                at = f"[{k}*NV+{v}]"
                sums.append((f"{{{{const V g={{}},h={{}};G{at}=g;D{at}=h;E{at}=g+h;}}}}", [*both]))
            yield from _woven(sums)

    def next(self) -> Iterator[str]:
        """The next covariance, its lower triangle by rows."""
        noisy = {i for i, j, _ in self.entries if j >= self.nx}
        for v in range(self.room):
            block = range(v * self.lanes, min((v + 1) * self.lanes, self.nx))
            same, filled = all(self.unit[i] == i for i in block), self.filled(v)
            sums = []
            for i in range(block.start, self.nx):
                own = [j for j in filled if j < self.nx]
                t = [(self.number("X", i, j), f"F[{j}*NV+{v}]") for j in own]
                noise = [j for j in filled if j >= self.nx and i in noisy]
                w = [(self.number("F", j, i), f"F[{j}*NV+{v}]") for j in noise]
                g = [(self.number("G", k, i), f"E[{k}*NV+{v}]") for k in range(self.ny)]
                h = [(self.number("D", k, i), f"G[{k}*NV+{v}]") for k in range(self.ny)]
                parts = [[] if same else t, w, g, h if self.fixed else []]
                text = "({}+{})-({}+{})"
                if same:
                    text = text.replace("{}", f"X[{i}*NV+{v}]", 1)
                    parts = parts[1:]
                if i in block and self.walk[i]:
                    text = f"({text})+((const V*)walks)[{i}]*ALL(dts[0])"
                sums.append((f"P[{i}*NV+{v}]={text};", parts))
            yield from _woven(sums)


def _table(kind: str, name: str, values: Sequence[str]) -> str:
    return (
        f"static const {kind} {name}[] __attribute__((aligned(64)))={{{','.join(values) or '0'}}};"
    )


def _ints(name: str, values: Sequence[int]) -> str:
    return _table("int", name, [*map(str, values)])


def _doubles(name: str, values: Sequence[float]) -> str:
    return _table("double", name, [*map(number, values)])


@once
def _writer() -> str:
    """Tell one writer of code from another: what is written here, and what lanes are written by."""
    return digest() + hashlib.sha256(Path(__file__).read_bytes()).hexdigest()


def row_block(name: str, rows: Rows, length: int, lanes: int, *, padded: float) -> Code:
    """Return the code of a block of steps; matrices in columns are lower halves.

    (m, P, P_f, u, y, R, dt, keep, p) -> (m1, P1, P_f, m_f, var, nu, diag S, stats, some), where the
    first P_f is the last sample's, and some are of the first ``SOME`` samples that ``keep`` marks.

    Args:
        name: of the function.
        rows: the step.
        length: steps at most.
        lanes: rows at once.
        padded: variance that ends a recording: there the block ends.
    """
    nx, nm, ny, np_, nu = (rows.symbols[k].shape[0] for k in (0, 1, 4, 3, 2))
    how = rows.fixed, rows.walk, rows.gain.sparsity_in(0), rows.forecast[1]
    layout = _Layout(nx, ny, lanes, *how)
    varying = ca.vertcat(*(e for _, _, e in layout.varying))
    forecast = rows.forecast[0], varying, rows.forecast[2]
    of_p, read, ahead = dataclasses.replace(rows, forecast=forecast).functions(name)
    functions = {"CONSTANTS": of_p, "READ": read, "GAIN": rows.gain, "FORECAST": ahead}
    half = nx * (nx + 1) // 2
    numbers = {"NX": nx, "NW": nm - nx, "NY": ny, "NU": nu, "NP": np_, "NC": of_p.nnz_out(0)}
    numbers |= {"NV": layout.room, "MV": layout.room - (nx - nm) // lanes, "K": length}
    numbers |= {"NH": rows.gain.nnz_in(0), "NF": varying.shape[0], "HALF": half, "SOME": SOME}
    numbers |= {"NCONST": len(layout.entries) - len(layout.varying)}
    numbers |= {"WORK": 1 + max(f.sz_w() for f in functions.values())}
    content = "\n".join([name, _writer(), *(f.serialize() for f in functions.values())])
    content += f"{lanes} {padded} {numbers} {rows.walk} {rows.fixed}"
    each = [(n, length) for n in (nu, ny, ny, 1, 1)]
    ins = [(nx, 1), (nx, nx), (nx, nx), *each, (np_, 1)]
    outs = [(nx, 1), (nx, nx), (nx, nx), *((n, length) for n in (nx, nx, ny, ny, 4)), (half, SOME)]

    def write() -> str:
        generator = ca.CodeGenerator("code.c", {"with_header": False})
        for f in functions.values():
            generator.add(f)
        words = [f"#define {n} {v}" for n, v in numbers.items()]
        words += [f"#define {n} {f.name()}" for n, f in functions.items()]
        words.append(f"#define PADDED ({number(padded)})")
        gains = [float(i not in rows.fixed) for i in range(nx)]
        line = [str(-int(b <= k)) for k in range(lanes) for b in range(lanes)]
        walks = [w * (i % lanes == k) for i, w in enumerate(rows.walk) for k in range(lanes)]
        mine = [_doubles("gains", gains), _doubles("walks", walks)]
        mine += [_table("int64_t", "below", line), *layout.tables()]
        given, made = ([ca.Sparsity.dense(*size) for size in sizes] for sizes in (ins, outs))
        frame = framed(name, INPUTS, OUTPUTS, given, made, 0)
        text = [generator.dump(), "#include <string.h>", Writer(lanes).source(), *mine, *words]
        text += [_TYPES, frame]
        for what, sizes in (("arg", ins), ("res", outs)):
            text += [f"if(!{what}[{k}])return 1;" for k, (n, _) in enumerate(sizes) if n]
        text += [_BEFORE, _READ, *layout.output(), _GAIN, *layout.gained()]
        return "\n".join([*text, _FORECAST, _FILTERED, *layout.ahead(), *layout.next(), _AFTER])

    return Code(name, content, write, flags_of(lanes))
