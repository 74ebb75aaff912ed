/* The brake behind the functions of FMI 3.0, co-simulation. No header of FMI is needed. */
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include "brake.c"

#if defined(FMI3_FUNCTION_PREFIX) && !defined(FMI3_OVERRIDE_FUNCTION_PREFIX) /* of sources that are linked */
#define JOINED(a, b) a##b
#define JOIN(a, b) JOINED(a, b)
#define NAME(name) JOIN(FMI3_FUNCTION_PREFIX, name)
#else
#define NAME(name) name
#endif
#ifdef _WIN32
#define EXPORT __declspec(dllexport)
#else
#define EXPORT
#endif
#define FMI(name) EXPORT status NAME(name)

typedef enum { OK, WARNING, DISCARD, ERROR, FATAL } status;
typedef const char *text;
typedef void (*logger)(void *environment, status found, text category, text message);
typedef struct {
  brake b;
  double time;
  int running;
  void *environment;
  logger log;
} instance;
typedef uint32_t reference;

#define PLACE(name) offsetof(instance, b.name)
static const size_t places[] = {
    offsetof(instance, time),
@places@
    PLACE(current), PLACE(angle), PLACE(velocity), PLACE(clamping_force), PLACE(friction_torque)};
enum { CURRENT = @current@, COUNT = CURRENT + 5 };

static const double least[] = {@least@};
static status refuse(const instance *c, text message) {
  if (c && c->log) c->log(c->environment, ERROR, "logStatusError", message);
  return ERROR;
}

EXPORT text NAME(fmi3GetVersion)(void) { return "3.0"; }

FMI(fmi3SetDebugLogging)(instance *c, _Bool on, size_t n, const text categories[]) { return c ? OK : ERROR; }

EXPORT instance *NAME(fmi3InstantiateCoSimulation)(text name, text token, text resources, _Bool visible, _Bool logging,
                                                   _Bool events, _Bool early, const reference needed[], size_t count,
                                                   void *environment, logger log, void (*update)(void)) {
  const instance refused = {.environment = environment, .log = log};
  instance *c = NULL;
  if (!token || strcmp(token, "@token@")) refuse(&refused, "the token is that of another FMU");
  else if (events || count) refuse(&refused, "this FMU has neither an event mode nor intermediate variables");
  else if (!(c = calloc(1, sizeof *c))) refuse(&refused, "no memory");
  if (!c) return NULL;
  *c = refused;
  brake_init(&c->b);
  return c;
}

EXPORT void *NAME(fmi3InstantiateModelExchange)(text a, text b, text c, _Bool d, _Bool e, void *f, logger g) {
  return 0;
}
EXPORT void *NAME(fmi3InstantiateScheduledExecution)(text a, text b, text c, _Bool d, _Bool e, void *f, logger g,
                                                     void (*h)(void), void (*i)(void), void (*j)(void)) { return 0; }
EXPORT void NAME(fmi3FreeInstance)(instance *c) { free(c); }

FMI(fmi3EnterInitializationMode)(instance *c, _Bool given, double tolerance, double start, _Bool ends, double stop) {
  return c->time = start, OK;
}
FMI(fmi3ExitInitializationMode)(instance *c) { return c->running = 1, OK; }
FMI(fmi3Terminate)(instance *c) { return c ? OK : ERROR; }
FMI(fmi3Reset)(instance *c) { return c->running = 0, brake_init(&c->b), OK; }

FMI(fmi3GetFloat64)(instance *c, const reference v[], size_t n, double x[], size_t m) {
  for (size_t k = 0; k < n; k++) {
    if (v[k] >= COUNT || n != m) return refuse(c, "no such variable");
    memcpy(&x[k], (const char *)c + places[v[k]], sizeof(double));
  }
  return OK;
}
FMI(fmi3SetFloat64)(instance *c, const reference v[], size_t n, const double x[], size_t m) {
  for (size_t k = 0; k < n; k++) {
    if (v[k] < 1 || v[k] > CURRENT || n != m) return refuse(c, "neither a parameter nor the current");
    if (!isfinite(x[k]) || x[k] < least[v[k]]) return refuse(c, "expected a number, not below min");
    if (places[v[k]] == PLACE(J) && x[k] <= 0.0) return refuse(c, "expected J above 0");
  }
  for (size_t k = 0; k < n; k++) memcpy((char *)c + places[v[k]], &x[k], sizeof(double));
  const double current = c->b.current;
  if (c->running) brake_outputs(&c->b);
  else brake_start(&c->b);
  c->b.current = current;
  return OK;
}
FMI(fmi3DoStep)(instance *c, double point, double size, _Bool final, _Bool *event, _Bool *ends, _Bool *early,
                double *last) {
  if (!(size > 0.0 && isfinite(size))) return refuse(c, "expected a step longer than 0 s");
  *last = c->time, *event = *ends = *early = 0;
  if (brake_step(&c->b, c->b.current, size)) return refuse(c, "no motion that can be computed: extreme parameters");
  c->time = *last = point + size;
  return OK;
}
FMI(fmi3GetFMUState)(instance *c, void **kept) {
  if (!*kept && !(*kept = malloc(sizeof *c))) return refuse(c, "no memory");
  memcpy(*kept, c, sizeof *c);
  return OK;
}
FMI(fmi3SetFMUState)(instance *c, void *kept) { return memcpy(c, kept, sizeof *c), OK; }
FMI(fmi3FreeFMUState)(instance *c, void **kept) { return free(*kept), *kept = NULL, OK; }

/* What this FMU has no use for. */
#define KEYS instance *c, const reference v[], size_t n
#define NONE(name, arguments) \
  FMI(name) arguments { return refuse(c, #name ": this FMU does not have it"); }
#define NO_TYPE(name, type) \
  NONE(fmi3Get##name, (KEYS, type x[], size_t m)) \
  NONE(fmi3Set##name, (KEYS, const type x[], size_t m))
NO_TYPE(Float32, float) NO_TYPE(Int8, int8_t) NO_TYPE(UInt8, uint8_t) NO_TYPE(Int16, int16_t) NO_TYPE(UInt16, uint16_t)
NO_TYPE(Int32, int32_t) NO_TYPE(UInt32, uint32_t) NO_TYPE(Int64, int64_t) NO_TYPE(UInt64, uint64_t)
NO_TYPE(Boolean, _Bool) NO_TYPE(String, text)
typedef const uint8_t *binary;
NONE(fmi3GetVariableDependencies, (instance *c, reference v, size_t a[], reference b[], size_t d[], int e[], size_t n))
NONE(fmi3UpdateDiscreteStates, (instance *c, _Bool *d, _Bool *e, _Bool *f, _Bool *g, _Bool *h, double *time))
NONE(fmi3DeserializeFMUState, (instance *c, const uint8_t x[], size_t size, void **kept))
NONE(fmi3GetNumberOfVariableDependencies, (instance *c, reference v, size_t *n)) NONE(fmi3GetClock, (KEYS, _Bool x[]))
NONE(fmi3SerializeFMUState, (instance *c, void *kept, uint8_t x[], size_t size))
NONE(fmi3GetOutputDerivatives, (KEYS, const int32_t o[], double x[], size_t m))
NONE(fmi3SetBinary, (KEYS, const size_t sizes[], const binary x[], size_t m))
NONE(fmi3SetIntervalFraction, (KEYS, const uint64_t x[], const uint64_t y[]))
NONE(fmi3CompletedIntegratorStep, (instance *c, _Bool d, _Bool *e, _Bool *f))
NONE(fmi3ActivateModelPartition, (instance *c, reference clock, double time))
NONE(fmi3GetIntervalFraction, (KEYS, uint64_t x[], uint64_t y[], int z[])) NONE(fmi3GetShiftDecimal, (KEYS, double x[]))
NONE(fmi3SetShiftFraction, (KEYS, const uint64_t x[], const uint64_t y[])) NONE(fmi3SetTime, (instance *c, double time))
NONE(fmi3SerializedFMUStateSize, (instance *c, void *kept, size_t *size)) NONE(fmi3SetClock, (KEYS, const _Bool x[]))
NONE(fmi3SetContinuousStates, (instance *c, const double x[], size_t n))
NONE(fmi3GetBinary, (KEYS, size_t sizes[], binary x[], size_t m)) NONE(fmi3SetIntervalDecimal, (KEYS, const double x[]))
NONE(fmi3GetNumberOfContinuousStates, (instance *c, size_t *n)) NONE(fmi3SetShiftDecimal, (KEYS, const double x[]))
NONE(fmi3GetShiftFraction, (KEYS, uint64_t x[], uint64_t y[])) NONE(fmi3GetIntervalDecimal, (KEYS, double x[], int y[]))
NONE(fmi3GetNumberOfEventIndicators, (instance *c, size_t *n))
#define NO_DERIVATIVE(name) \
  NONE(name, (instance *c, const reference u[], size_t n, const reference k[], size_t m, \
              const double seed[], size_t seeds, double x[], size_t xs))
NO_DERIVATIVE(fmi3GetDirectionalDerivative) NO_DERIVATIVE(fmi3GetAdjointDerivative)
#define NO_MODE(name) NONE(name, (instance *c))
NO_MODE(fmi3EnterConfigurationMode) NO_MODE(fmi3ExitConfigurationMode) NO_MODE(fmi3EnterEventMode)
NO_MODE(fmi3EvaluateDiscreteStates) NO_MODE(fmi3EnterContinuousTimeMode) NO_MODE(fmi3EnterStepMode)
#define NO_STATES(name) NONE(name, (instance *c, double x[], size_t n))
NO_STATES(fmi3GetContinuousStateDerivatives) NO_STATES(fmi3GetEventIndicators) NO_STATES(fmi3GetContinuousStates)
NO_STATES(fmi3GetNominalsOfContinuousStates)
