/* exp, log, pow, sin and cos of all lanes at once; see vectormath.py, which writes tables and
   constants before this.  V holds L doubles, M as many integers; v_all, v_sel, v_bits and v_fabs
   are the lanes' own.  What is hi + lo carries twice the digits of a double. */
#if defined(__GLIBC__) && defined(__GLIBC_MINOR__)
#if __GLIBC__ > 2 || __GLIBC_MINOR__ >= 28
#if L == 8 && defined(__AVX512F__) && defined(__AVX512DQ__)
#define VECTOR_MATH
#define FMA(a, b, c) ((V)_mm512_fmadd_pd((__m512d)(a), (__m512d)(b), (__m512d)(c)))
#define OF16(t, i)                                                                                 \
  ((V)_mm512_permutex2var_pd(_mm512_loadu_pd(t), (__m512i)(i), _mm512_loadu_pd(t + 8)))
#define OF64(t, i) ((V)_mm512_i64gather_pd((__m512i)(i), t, 8))
#define SHIFT_52(i) ((M)_mm512_srai_epi64((__m512i)(i), 52))
#define NUMBER(i) ((V)_mm512_cvtepi64_pd((__m512i)(i)))
#endif
#endif
#endif

#ifdef VECTOR_MATH

#define C(x) v_all(x)
#define ROUND C(0x1.8p52)
#define NI static __attribute__((noinline, unused))

/* asks the C library for the lanes whose bits are set */
#define SLOW_1(f)                                                                                  \
  NI V slow_##f(V y, V a, unsigned bits)                                                           \
  {                                                                                                \
    TO_SCALAR                                                                                      \
    for (; bits; bits &= bits - 1) {                                                               \
      const int l = __builtin_ctz(bits);                                                           \
      ((double *)&y)[l] = f(((double *)&a)[l]);                                                    \
    }                                                                                              \
    return y;                                                                                      \
  }
#define SLOW_2(f)                                                                                  \
  NI V slow_##f(V y, V a, V b, unsigned bits)                                                      \
  {                                                                                                \
    TO_SCALAR                                                                                      \
    for (; bits; bits &= bits - 1) {                                                               \
      const int l = __builtin_ctz(bits);                                                           \
      ((double *)&y)[l] = f(((double *)&a)[l], ((double *)&b)[l]);                                 \
    }                                                                                              \
    return y;                                                                                      \
  }
SLOW_1(exp)
SLOW_1(log)
SLOW_1(sin)
SLOW_1(cos)
SLOW_2(pow)

/* hi + lo, rounded; ok: the C library, off by e at most, has no choice (share = 1/(2 - 2e)) */
IN V rounded(V hi, V lo, double share, M *ok)
{
  const V y = hi + lo;
  const V rest = (hi - y) + lo;
  *ok = y == y + rest * C(share);
  return y;
}

/* 2^m T (1 + t + ...) of x + tail, |x| < 708; tail far smaller */
IN V exp_of(V x, V tail, double share, M *ok)
{
  const V z = FMA(x, C(EXP_INV), ROUND);
  const V k = z - ROUND;
  const M i = (M)z;
  const V a = FMA(k, C(-EXP_L1), x);
  const V t = FMA(k, C(-EXP_L2), a);
  const V rest = FMA(k, C(-EXP_L2), a - t) + tail;
  const M j = i & (M){EXP_MASK};
  const V T = OF16(exp_hi, j);
  const V Tl = OF16(exp_lo, j);
  V s = C(1.0 / 40320);
  s = FMA(s, t, C(1.0 / 5040));
  s = FMA(s, t, C(1.0 / 720));
  s = FMA(s, t, C(1.0 / 120));
  s = FMA(s, t, C(1.0 / 24));
  s = FMA(s, t, C(1.0 / 6));
  s = FMA(s, t, C(0.5));
  s = FMA(s, t * t, rest);
  s = FMA(rest, t, s);
  const V u = T * t;
  const V ul = FMA(T, t, -u);
  const V hi = T + u;
  const V lo = ((T - hi) + u) + (ul + FMA(T, s, FMA(Tl, t, Tl)));
  const V y = rounded(hi, lo, share, ok);
  return (V)((M)y + ((i - j) << (52 - 4)));
}

/* log x = *hi + *lo of normal positive numbers */
IN void log_of(V x, V *hi, V *lo)
{
  const M from = (M)x - (M){LOG_FROM};
  const M e = SHIFT_52(from);
  const M j = (from >> (52 - 4)) & (M){EXP_MASK};
  const V m = (V)((M)x - (e << 52));
  const V q = OF16(log_inv, j);
  const V k = NUMBER(e);
  const V p = m * q;
  const V pl = FMA(m, q, -p);
  const V r = p - C(1.0);
  const V A = FMA(k, C(LOG_L1), OF16(log_hi, j));
  const V B = FMA(k, C(LOG_L2), OF16(log_lo, j));
  V s = C(-1.0 / 12);
  s = FMA(s, r, C(1.0 / 11));
  s = FMA(s, r, C(-1.0 / 10));
  s = FMA(s, r, C(1.0 / 9));
  s = FMA(s, r, C(-1.0 / 8));
  s = FMA(s, r, C(1.0 / 7));
  s = FMA(s, r, C(-1.0 / 6));
  s = FMA(s, r, C(1.0 / 5));
  s = FMA(s, r, C(-1.0 / 4));
  s = FMA(s, r, C(1.0 / 3));
  const V h = A + r;
  const V e1 = (A - h) + r;
  const V rr = r * r;
  const V rl = FMA(r, r, -rr);
  const V g = FMA(rr, C(-0.5), h);
  const V e2 = FMA(rr, C(-0.5), h - g);
  const V f = FMA(FMA(r, r, -r), pl, pl);
  const V l = FMA(s, rr * r, (e1 + e2) + (FMA(rl, C(-0.5), f) + B));
  *hi = g + l;
  *lo = (g - *hi) + l;
}

NI V v_exp(V x)
{
  M ok;
  const M in = (x > C(-708.0)) & (x < C(709.0));
  const V y = exp_of(v_sel(in, x, C(0.0)), C(0.0), 1.025, &ok);
  ok &= in;
  const unsigned no = v_bits(~ok);
  return no ? slow_exp(y, x, no) : y;
}

NI V v_log(V x)
{
  V h, l;
  M ok;
  const M in = (x >= C(0x1p-1022)) & (x < C(INFINITY));
  log_of(v_sel(in, x, C(1.0)), &h, &l);
  const V y = rounded(h, l, 1.045, &ok);
  ok &= in;
  const unsigned no = v_bits(~ok);
  return no ? slow_log(y, x, no) : y;
}

NI V v_pow(V x, V b)
{
  V h, l;
  M ok;
  M in = (x >= C(0x1p-1022)) & (x < C(INFINITY)) & (v_fabs(b) < C(1e6));
  log_of(v_sel(in, x, C(1.0)), &h, &l);
  const V c = v_sel(in, b, C(0.0));
  const V p = c * h;
  const V t = FMA(c, l, FMA(c, h, -p));
  in &= v_fabs(p) < C(8.0);
  const V y = exp_of(v_sel(in, p, C(0.0)), v_sel(in, t, C(0.0)), 1.03, &ok);
  ok &= in;
  const unsigned no = v_bits(~ok);
  return no ? slow_pow(y, x, b, no) : y;
}

/* S cos r + C sin r, where x = j 2 pi/64 + r */
IN V sin_of(V x, int more, M *ok)
{
  const M in = v_fabs(x) < C(4e5);
  const V d = v_sel(in, x, C(1.0));
  const V z = FMA(d, C(SIN_INV), ROUND);
  const V n = z - ROUND;
  const M j = ((M)z + more) & (M){TURN_MASK};
  const V a = FMA(n, C(-SIN_L1), d);
  const V b = n * C(-SIN_L2);
  const V th = a + b;
  const V bb = th - a;
  const V tl = (a - (th - bb)) + (b - bb);
  const V w = FMA(n, C(-SIN_L3), tl);
  const V r = th + w;
  const V rl = (th - r) + w;
  const V S = OF64(sin_hi, j);
  const V Sl = OF64(sin_lo, j);
  const V K = OF64(cos_hi, j);
  const V Kl = OF64(cos_lo, j);
  const V q = r * r;
  V s = C(1.0 / 362880);
  V c = C(-1.0 / 3628800);
  s = FMA(s, q, C(-1.0 / 5040));
  s = FMA(s, q, C(1.0 / 120));
  s = FMA(s, q, C(-1.0 / 6));
  c = FMA(c, q, C(1.0 / 40320));
  c = FMA(c, q, C(-1.0 / 720));
  c = FMA(c, q, C(1.0 / 24));
  c = FMA(c, q, C(-0.5));
  s = FMA(s * q, r, rl);
  c = FMA(c, q, -r * rl); /* sin r - r, cos r - 1 */
  const V u = K * r;
  const V ul = FMA(K, r, -u);
  const V h = S + u;
  const V back = h - S;
  const V e = (S - (h - back)) + (u - back);
  const V l = e + (ul + (FMA(Kl, r, Sl) + FMA(K, s, S * c)));
  const V y = rounded(h, l, 1.125, ok);
  *ok &= in & ((n == C(0.0)) | (v_fabs(r) > C(0x1p-20)));
  return y;
}

NI V v_sin(V x)
{
  M ok;
  V y = sin_of(x, 0, &ok);
  ok &= x != C(0.0);
  const unsigned no = v_bits(~ok);
  return no ? slow_sin(y, x, no) : y;
}

NI V v_cos(V x)
{
  M ok;
  V y = sin_of(x, TURN / 4, &ok);
  const unsigned no = v_bits(~ok);
  return no ? slow_cos(y, x, no) : y;
}
#undef C
#else
#define EACH_1(f) __attribute__((unused)) EACH(f)
EACH_1(exp)
EACH_1(log)
EACH_1(sin)
EACH_1(cos)
__attribute__((unused)) static V v_pow(V a, V b)
{
  V r;
  TO_SCALAR
  for (int l = 0; l < L; l++)
    r[l] = pow(a[l], b[l]);
  return r;
}
#endif
