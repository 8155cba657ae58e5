/* The functions of FMI 2.0 for co-simulation and model exchange. */
#include <stddef.h>
#include <stdlib.h>
#include <string.h>

#include "unit.h"

#if defined _WIN32
#define FMI __declspec(dllexport)
#elif defined __GNUC__
#define FMI __attribute__((visibility("default")))
#else
#define FMI
#endif

typedef int Status;
typedef unsigned int Reference;

typedef struct {
  void (*logger)(void *host, const char *name, Status status, const char *category,
                 const char *message, ...);
  void *(*allocate)(size_t n, size_t size);
  void (*release)(void *what);
  void (*finished)(void *host, Status status);
  void *host;
} Callbacks;

typedef struct {
  int again, terminate, nominals, values, defined;
  double next;
} EventInfo;

void host_message(Unit *u, int status, const char *text)
{
  const Callbacks *f = u->log;
  if (f && f->logger)
    f->logger(f->host, NAME, status, status == WRONG ? "logStatusError" : "logStatusDiscard", "%s",
              text);
}

FMI const char *fmi2GetTypesPlatform(void) { return "default"; }
FMI const char *fmi2GetVersion(void) { return "2.0"; }

FMI Status fmi2SetDebugLogging(void *c, int on, size_t n, const char *const categories[])
{
  (void)c; (void)on; (void)n; (void)categories;
  return FINE;
}

FMI void *fmi2Instantiate(const char *name, int type, const char *token, const char *path,
                          const Callbacks *functions, int visible, int logging)
{
  Unit *u = calloc(1, sizeof *u);
  (void)name; (void)path; (void)visible; (void)logging;
  if (u == NULL)
    return NULL;
  /* the host keeps the callbacks for as long as the instance lives */
  memcpy(&u->log, &functions, sizeof u->log);
  u->exchange = type == 0;
  unit_reset(u);
  if (token == NULL || strcmp(token, TOKEN)) {
    unit_tell(u, WRONG, "the GUID is of another model description", 0.0);
    free(u);
    return NULL;
  }
  return u;
}

FMI void fmi2FreeInstance(void *c) { free(c); }

FMI Status fmi2SetupExperiment(void *c, int defined, double tolerance, double start,
                               int stop_defined, double stop)
{
  Unit *u = c;
  (void)defined; (void)tolerance; (void)stop_defined; (void)stop;
  u->start = u->v[AT_TIME] = start;
  return FINE;
}

FMI Status fmi2EnterInitializationMode(void *c)
{
  ((Unit *)c)->stale = 1;
  return FINE;
}

FMI Status fmi2ExitInitializationMode(void *c)
{
  Unit *u = c;
  const Status status = unit_refresh(u);
  u->phase = READY;
  return status == FINE ? FINE : WRONG;
}

FMI Status fmi2Terminate(void *c)
{
  ((Unit *)c)->phase = STOPPED;
  return FINE;
}

FMI Status fmi2Reset(void *c) { unit_reset(c); return FINE; }

FMI Status fmi2GetReal(void *c, const Reference at[], size_t n, double values[])
{
  size_t i;
  for (i = 0; i < n; i++) {
    const Status status = unit_get(c, at[i], &values[i]);
    if (status != FINE)
      return status;
  }
  return FINE;
}

FMI Status fmi2SetReal(void *c, const Reference at[], size_t n, const double values[])
{
  size_t i;
  for (i = 0; i < n; i++) {
    const Status status = unit_set(c, at[i], values[i]);
    if (status != FINE)
      return status;
  }
  return FINE;
}

/* There are no variables of other types. */
#define NONE(name, type)                                                                     \
  FMI Status fmi2Get##name(void *c, const Reference at[], size_t n, type values[])           \
  {                                                                                          \
    (void)c; (void)at; (void)values;                                                         \
    return n ? WRONG : FINE;                                                                 \
  }                                                                                          \
  FMI Status fmi2Set##name(void *c, const Reference at[], size_t n, const type values[])     \
  {                                                                                          \
    (void)c; (void)at; (void)values;                                                         \
    return n ? WRONG : FINE;                                                                 \
  }
typedef const char *String;
NONE(Integer, int)
NONE(Boolean, int)
NONE(String, String)

FMI Status fmi2GetFMUstate(void *c, void **state)
{
  if (*state == NULL)
    *state = malloc(sizeof(Unit));
  if (*state == NULL)
    return WRONG;
  memcpy(*state, c, sizeof(Unit));
  return FINE;
}

FMI Status fmi2SetFMUstate(void *c, void *state)
{
  memcpy(c, state, offsetof(Unit, host));
  return FINE;
}

FMI Status fmi2FreeFMUstate(void *c, void **state)
{
  (void)c;
  free(*state);
  *state = NULL;
  return FINE;
}

FMI Status fmi2SerializedFMUstateSize(void *c, void *state, size_t *size)
{
  (void)c; (void)state;
  *size = offsetof(Unit, host);
  return FINE;
}

FMI Status fmi2SerializeFMUstate(void *c, void *state, char bytes[], size_t size)
{
  (void)c;
  if (size < offsetof(Unit, host))
    return WRONG;
  memcpy(bytes, state, offsetof(Unit, host));
  return FINE;
}

FMI Status fmi2DeSerializeFMUstate(void *c, const char bytes[], size_t size, void **state)
{
  if (size < offsetof(Unit, host) || fmi2GetFMUstate(c, state) != FINE)
    return WRONG;
  memcpy(*state, bytes, offsetof(Unit, host));
  return FINE;
}

FMI Status fmi2GetDirectionalDerivative(void *c, const Reference unknowns[], size_t n,
                                        const Reference knowns[], size_t k, const double seed[],
                                        double sensitivity[])
{
  (void)c; (void)unknowns; (void)n; (void)knowns; (void)k; (void)seed; (void)sensitivity;
  return WRONG;
}

/* ------------------------------------------------------------------------- model exchange */

FMI Status fmi2EnterEventMode(void *c) { (void)c; return FINE; }

FMI Status fmi2NewDiscreteStates(void *c, EventInfo *info)
{
  Unit *u = c;
  double before[N_X];
  memcpy(before, u->v + AT_X, sizeof before);
  memset(info, 0, sizeof *info);
  model_switch(u);
  info->values = memcmp(before, u->v + AT_X, sizeof before) != 0;
  u->stale = u->stale || info->values;
  return FINE;
}

FMI Status fmi2EnterContinuousTimeMode(void *c) { (void)c; return FINE; }

FMI Status fmi2CompletedIntegratorStep(void *c, int no_set, int *event, int *terminate)
{
  (void)c; (void)no_set;
  *event = *terminate = 0;
  return FINE;
}

FMI Status fmi2SetTime(void *c, double time)
{
  ((Unit *)c)->v[AT_TIME] = time;
  return FINE;
}

FMI Status fmi2SetContinuousStates(void *c, const double x[], size_t n)
{
  return unit_move(c, x, n);
}

FMI Status fmi2GetDerivatives(void *c, double rates[], size_t n)
{
  return unit_give(c, ((Unit *)c)->v + AT_D, rates, n, 1);
}

FMI Status fmi2GetContinuousStates(void *c, double x[], size_t n)
{
  return unit_give(c, ((Unit *)c)->v + AT_X, x, n, 0);
}

FMI Status fmi2GetNominalsOfContinuousStates(void *c, double nominals[], size_t n)
{
  return unit_give(c, X_NOMINAL, nominals, n, 0);
}

FMI Status fmi2GetEventIndicators(void *c, double indicators[], size_t n)
{
  (void)c; (void)indicators;
  return n ? WRONG : FINE;
}

/* ------------------------------------------------------------------------- co-simulation */

FMI Status fmi2SetRealInputDerivatives(void *c, const Reference at[], size_t n, const int order[],
                                       const double value[])
{
  (void)c; (void)at; (void)order; (void)value;
  return n ? WRONG : FINE;
}

FMI Status fmi2GetRealOutputDerivatives(void *c, const Reference at[], size_t n,
                                        const int order[], double value[])
{
  (void)c; (void)at; (void)order; (void)value;
  return n ? WRONG : FINE;
}

FMI Status fmi2DoStep(void *c, double t, double h, int no_set)
{
  (void)no_set;
  return unit_advance(c, t, h) == FINE ? FINE : WRONG;
}

FMI Status fmi2CancelStep(void *c) { (void)c; return WRONG; }

FMI Status fmi2GetStatus(void *c, int kind, Status *value)
{
  (void)c; (void)kind; (void)value;
  return DISCARD;
}

FMI Status fmi2GetRealStatus(void *c, int kind, double *value)
{
  if (kind != 2)
    return DISCARD;
  *value = ((Unit *)c)->v[AT_TIME];
  return FINE;
}

FMI Status fmi2GetIntegerStatus(void *c, int kind, int *value)
{
  (void)c; (void)kind; (void)value;
  return DISCARD;
}

FMI Status fmi2GetBooleanStatus(void *c, int kind, int *value)
{
  if (kind != 3)
    return DISCARD;
  (void)c;
  *value = 0;
  return FINE;
}

FMI Status fmi2GetStringStatus(void *c, int kind, const char **value)
{
  (void)c; (void)kind; (void)value;
  return DISCARD;
}
