/* An instance of the exported model, as the FMI's functions and the models see it.

   One array holds all variables in the order of their value references: time, inputs,
   parameters, states, rates of the states, outputs.  Sizes and numbers come from model.h,
   which is written for each export. */
#ifndef UNIT_H
#define UNIT_H

#include <stddef.h>

#include "model.h"

enum {
  AT_TIME = 0,
  AT_U = 1,
  AT_P = AT_U + N_U,
  AT_X = AT_P + N_P,
  AT_D = AT_X + N_X,
  AT_Y = AT_D + N_X,
  N_V = AT_Y + N_Y
};

enum { INITIAL, READY, STOPPED };        /* before, during, after a simulation */
enum { FINE = 0, DISCARD = 2, WRONG = 3 }; /* as the FMI's status */

typedef int (*Function)(const double **arg, double **res, long long int *iw, double *w, int mem);

/* A generator: equations without and with its fault, and where its variables are. */
typedef struct {
  Function f[2], g[2], jacobian[2], follow[2];
  int size[2];              /* states of each */
  const int *healthy;       /* those of all states that the healthy equations have */
  const int *reset;         /* those that the fault brings */
  const int *means;         /* outputs that are averaged over a step */
  const double *nominal, *numbers;
  int n_reset, n_numbers, n_inputs, n_fault, n_outputs;
  int axis;                 /* which of the fault's parameters turns it; -1: none */
  int angle;                /* which state is the rotor's */
  int u, p, x, y;           /* first of its inputs, parameters, states, outputs */
  int like;                 /* first generator with the same equations and numbers */
} Equations;

extern const Equations MACHINES[];

/* A generator between two switches. */
typedef struct {
  int faulty;               /* which equations hold */
  int moved;                /* the fault has come, gone or moved, and its states are old */
  double theta[M_TH];       /* what they take of the parameters */
  double u[M_U];            /* speed, voltage reference, load, noise */
  double step;              /* last step of the integrator, s */
  double axis;              /* of the phase with the fault, rad */
} Machine;

typedef struct Unit Unit;

struct Unit {
  double v[N_V];
  double start;             /* of the simulation, s */
  int exchange;             /* model exchange, not co-simulation */
  int phase;                /* INITIAL, READY, STOPPED */
  int stale;                /* rates and outputs are to be computed anew */
  int changed;              /* inputs or parameters, since the last switch */
  double z[N_Z];            /* algebraic unknowns: where their next search starts */
  double means[N_GENERATORS][N_MEANS]; /* over the last exchange step */
  Machine machine[N_GENERATORS];
  /* what does not belong to the state */
  void *host, *log;
  const double *arg[W_ARG];
  double *res[W_RES];
  long long int iw[W_IW];
  double w[W_W];
};

/* What a model does; FINE, DISCARD or WRONG. */
int model_start(Unit *u);              /* after initialisation: what is not among the variables */
int model_evaluate(Unit *u);           /* rates and outputs at this instant */
int model_switch(Unit *u);             /* after a change of inputs or parameters; may move states */
int model_step(Unit *u, double h);     /* goes on by h, at most STEP, from the time of v */

/* unit.c */
void unit_reset(Unit *u);
int unit_refresh(Unit *u);
int unit_get(Unit *u, unsigned int at, double *value);
int unit_set(Unit *u, unsigned int at, double value);
/* n values, one a state: rates (fresh), states, magnitudes */
int unit_give(Unit *u, const double *from, double *to, size_t n, int fresh);
int unit_move(Unit *u, const double *x, size_t n);
int unit_advance(Unit *u, double t, double h);
int unit_call(Unit *u, Function f, const double *const *in, int n_in, double *const *out,
              int n_out);
int unit_tell(Unit *u, int status, const char *what, double value);

/* fmi2.c or fmi3.c: a message for the host */
void host_message(Unit *u, int status, const char *text);

#define IN(...) ((const double *const[]){__VA_ARGS__}), \
  (int)(sizeof((const double *const[]){__VA_ARGS__}) / sizeof(const double *))
#define OUT(...) ((double *const[]){__VA_ARGS__}), \
  (int)(sizeof((double *const[]){__VA_ARGS__}) / sizeof(double *))

#endif
