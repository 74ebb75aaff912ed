
void brake_outputs(brake *b) {
  b->angle = b->x1 + b->contact;
  b->velocity = b->x2;
  b->clamping_force = force(b);
  const double most = largest_holding(b), pull = b->k_m * b->i - b->gamma * b->clamping_force;
  b->friction_torque = b->x2 != 0.0 ? sliding(b) : fmax(-most, fmin(pull, most));
}

void brake_start(brake *b) {
  b->x1 = b->x1_0 - b->contact;
  b->x2 = b->x2_0;
  b->w = b->i = b->current = 0.0;
  brake_outputs(b);
}

void brake_init(brake *b) {
@values@
  brake_start(b);
}

static const double LEAST[] = {@least@};
static const double GREATEST[] = {@greatest@}; /* of each parameter */
static int permitted(unsigned k, double value) { return LEAST[k] <= value && value <= GREATEST[k]; }

int brake_step(brake *b, double current, double dt) {
  const brake before = *b;
  if (!(isfinite(current) && isfinite(dt) && dt >= 0.0)) return 1;
  for (unsigned k = 0; k < sizeof LEAST / sizeof *LEAST; k++) if (!permitted(k, ((const double *)b)[k])) return 1;
  b->current = current;
  const int passed = advance(b, current, dt);
  brake_outputs(b);
  if (passed && isfinite(b->angle + b->velocity + b->clamping_force + b->friction_torque + b->w + b->i)) return 0;
  return *b = before, passed ? 1 : 2;
}
#endif
