#ifndef RADAU_H
#define RADAU_H
#include "unit.h"

/* Generator k over [0, length], and the means of its outputs over it; see radau.c. */
int radau(Unit *u, int k, double *x, double length, double *means);

#endif
