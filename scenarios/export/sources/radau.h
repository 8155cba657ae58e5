#ifndef RADAU_H
#define RADAU_H
#include "unit.h"

/* dx/dt = f(x) over [0, length], and the means of the outputs over it; see radau.c. */
int radau(Unit *u, double *x, double length, double *means);

#endif
