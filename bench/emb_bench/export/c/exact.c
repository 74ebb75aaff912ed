/* Exact between events: contact, standstill, sticking, reversal. A segment is its Taylor series. */
static const int TERMS = 8;
static const double LONGEST = 0.05; /* segment, times the rate of its derivatives */

typedef struct { double x1, x2, a; } motion;

static motion glide(double damping, double spring, motion at, double t) {
  double first = at.x2, second = at.a, term = t;
  for (int n = 1; n < TERMS; n++) {
    const double third = -damping * second - spring * first;
    at.x1 += first * term;
    at.x2 += second * term;
    at.a += third * term;
    first = second;
    second = third;
    term *= t / (n + 1);
  }
  return at;
}

/* Time at which the velocity, or else the angle, comes to zero: Newton within a bracket. */
static double crossing(double damping, double spring, motion at, double t, int of_velocity) {
  const double start = of_velocity ? at.x2 : at.x1;
  double slope = of_velocity ? at.a : at.x2, low = 0.0, high = t;
  double guess = start * slope < 0.0 ? fmin(-start / slope, t) : t;
  for (int k = 0; k < 60; k++) {
    const motion m = glide(damping, spring, at, guess);
    const double value = of_velocity ? m.x2 : m.x1;
    slope = of_velocity ? m.a : m.x2;
    if (value * start > 0.0) low = guess;
    else high = guess;
    const double newton = slope != 0.0 ? guess - value / slope : -1.0;
    if (value == 0.0 || fmin(fabs(newton - guess), high - low) <= 1e-15 * t) break;
    guess = low < newton && newton < high ? newton : 0.5 * (low + high);
  }
  return guess;
}

static double force(const brake *b) { return b->k_1 * fmax(b->x1, 0.0); }
static double largest_holding(const brake *b) { return b->T_c; }
static double sliding(const brake *b) {
  return copysign(b->T_c, b->x2) + b->f_v * (1.0 + copysign(b->viscous_asymmetry, b->x2)) * b->x2;
}

static int advance(brake *b, double u, double left) {
  const double drive = b->k_m * u / b->J, stiffness = b->gamma * b->k_1 / b->J;
  const double coulomb = b->T_c / b->J, viscous = b->f_v / b->J;
  b->i = u;
  for (int n = 0; left > 0.0 && n < MOST; n++) {
    const double pull = drive - stiffness * fmax(b->x1, 0.0);
    const double direction = (b->x2 != 0.0 ? b->x2 : pull) > 0.0 ? 1.0 : -1.0;
    const double damping = viscous * (1.0 + direction * b->viscous_asymmetry);
    if (b->x2 == 0.0 && fabs(pull) <= coulomb) return 1; /* sticks */
    const double spring = b->x1 > 0.0 || (b->x1 == 0.0 && direction > 0.0) ? stiffness : 0.0;
    const motion at = {b->x1, b->x2, pull - direction * coulomb - damping * b->x2};
    double t = fmin(left, LONGEST / (damping + sqrt(stiffness)));
    motion next = glide(damping, spring, at, t);
    int stops = next.x2 * direction <= 0.0;
    if (stops && at.x2 != 0.0) {
      t = crossing(damping, spring, at, t, 1);
      next = glide(damping, spring, at, t);
    }
    if ((at.x1 < 0.0 && next.x1 > 0.0) || (at.x1 > 0.0 && next.x1 < 0.0)) {
      t = crossing(damping, spring, at, t, 0);
      next = glide(damping, spring, at, t);
      next.x1 = 0.0;
      stops = next.x2 == 0.0;
    }
    b->x1 = next.x1;
    b->x2 = stops ? 0.0 : next.x2;
    left -= t;
  }
  return left <= 0.0;
}
