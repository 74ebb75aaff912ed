/* Between events by the Runge-Kutta pair of Dormand and Prince; steps end at events, found as roots in their length. */
static const double ROUNDING = 1e-13, SHORTEST = 1e-9, FIRST = 1e-5, SATURATED = 1.0 - 1e-9;

typedef struct { double direction, x1, x2, w, rate, loaded, i, u; } slide; /* start of a step, and its laws */
typedef struct { double x1, x2, a, error; } step_end;
typedef enum { ANGLE, VELOCITY, ACCELERATION } quantity;

/* Share of the static friction beyond T_c that is left at a speed. */
static double decay(const brake *b, double speed) {
  if (b->stribeck_velocity == 0.0) return 0.0;
  const double ratio = fabs(speed / b->stribeck_velocity);
  return exp(-(b->stribeck_exponent == 2.0 ? ratio * ratio : pow(ratio, b->stribeck_exponent)));
}
static double static_torque(const brake *b, double load) { return b->break_away * b->T_c + b->f_l * load; }
static double sliding_torque(const brake *b, double speed, double load, double left) {
  return b->T_c + (static_torque(b, load) - b->T_c) * left + b->f_v * speed;
}

static double travel(const brake *b, double x1, double w) { return b->play > 0.0 ? x1 - w : x1; }
static double force_in_contact(const brake *b, double x1, double w) {
  const double x = travel(b, x1, w);
  return b->k_1 * x * (1.0 + x * (b->quadratic + x * b->cubic)) * (1.0 + b->hysteresis * w);
}
static double force(const brake *b) { return travel(b, b->x1, b->w) > 0.0 ? force_in_contact(b, b->x1, b->w) : 0.0; }
static double largest_holding(const brake *b) { return static_torque(b, force(b)); }
static double sliding(const brake *b) {
  return copysign(sliding_torque(b, fabs(b->x2), force(b), decay(b, b->x2)), b->x2);
}

static double stop_limit(const brake *b) { return b->play > 0.0 ? 0.5 * b->play : 1.0; }
static double stop_rate(const brake *b, double w, double direction) {
  if (w * direction >= SATURATED * stop_limit(b)) return 0.0;
  if (b->play > 0.0) return 1.0;
  return b->hysteresis > 0.0 ? 1.0 / b->hysteresis_travel : 0.0;
}

/* The next angle ahead where the force changes its law: contact, or saturation of w. */
static double edge_ahead(const brake *b, double x1, double w, double direction) {
  const double rate = stop_rate(b, w, direction);
  if (b->play > 0.0) {
    if (rate > 0.0) return x1 + (direction * stop_limit(b) - w);
    return (w - x1) * direction > 0.0 ? w : direction * HUGE_VAL;
  }
  if (x1 < 0.0) return direction > 0.0 ? 0.0 : -HUGE_VAL;
  if (direction > 0.0) return rate > 0.0 ? x1 + (1.0 - w) / rate : HUGE_VAL;
  if (x1 == 0.0) return -HUGE_VAL;
  return rate > 0.0 ? fmax(0.0, x1 - (1.0 + w) / rate) : 0.0;
}

static double current_after(const brake *b, double i, double u, double t) {
  return b->current_lag == 0.0 ? u : u + (i - u) * exp(-t / b->current_lag);
}

static double acceleration(const brake *b, const slide *a, double t, double x1, double x2) {
  const double load = force_in_contact(b, x1, a->w + a->rate * (x1 - a->x1)) * a->loaded;
  const double friction = a->direction * sliding_torque(b, x2 * a->direction, load, decay(b, x2));
  return (b->k_m * current_after(b, a->i, a->u, t) - b->gamma * load - friction) / b->J;
}

static step_end runge_kutta(const brake *b, const slide *a, double a1, double h) {
  static const double C[] = {0.0, 1.0 / 5.0, 3.0 / 10.0, 4.0 / 5.0, 8.0 / 9.0, 1.0, 1.0};
  static const double A[][6] = {
      {0.0}, {1.0 / 5.0}, {3.0 / 40.0, 9.0 / 40.0}, {44.0 / 45.0, -56.0 / 15.0, 32.0 / 9.0},
      {19372.0 / 6561.0, -25360.0 / 2187.0, 64448.0 / 6561.0, -212.0 / 729.0},
      {9017.0 / 3168.0, -355.0 / 33.0, 46732.0 / 5247.0, 49.0 / 176.0, -5103.0 / 18656.0},
      {35.0 / 384.0, 0.0, 500.0 / 1113.0, 125.0 / 192.0, -2187.0 / 6784.0, 11.0 / 84.0}};
  static const double E[] = {71.0 / 57600.0, 0.0, -71.0 / 16695.0, 71.0 / 1920.0, -17253.0 / 339200.0, 22.0 / 525.0,
                             -1.0 / 40.0}; /* of order 5 less that of order 4 */
  double v[7] = {a->x2}, d[7] = {a1}, x = a->x1, error = 0.0;
  for (int n = 1; n < 7; n++) {
    double moved = 0.0, gained = 0.0;
    for (int k = 0; k < n; k++) {
      moved += A[n][k] * v[k];
      gained += A[n][k] * d[k];
    }
    x = a->x1 + h * moved;
    v[n] = a->x2 + h * gained;
    d[n] = acceleration(b, a, C[n] * h, x, v[n]);
  }
  for (int n = 0; n < 7; n++) error += E[n] * d[n];
  const step_end end = {x, v[6], d[6], fabs(h * error)};
  return end;
}

static double value_of(step_end m, quantity which) { return which == ANGLE ? m.x1 : which == VELOCITY ? m.x2 : m.a; }

/* The step up to h cut where a quantity comes to its goal: the Illinois variant of regula falsi. */
static double root(const brake *b, const slide *a, double before, double h, quantity which, double goal) {
  const step_end start = {a->x1, a->x2, before, 0.0};
  double low = 0.0, high = h, f_low = value_of(start, which) - goal;
  double f_high = value_of(runge_kutta(b, a, before, h), which) - goal;
  for (int k = 0, moved = 0; k < 100 && f_high != 0.0 && high - low > 1e-15 * h; k++) {
    double guess = high - f_high * (high - low) / (f_high - f_low);
    if (!(low < guess && guess < high)) guess = 0.5 * (low + high);
    if (!(low < guess && guess < high)) break;
    const double value = value_of(runge_kutta(b, a, before, guess), which) - goal;
    if (value * f_low > 0.0) {
      low = guess, f_low = value;
      if (moved < 0) f_high *= 0.5;
      moved = -1;
    } else {
      high = guess, f_high = value;
      if (moved > 0) f_low *= 0.5;
      moved = 1;
    }
  }
  return high;
}

/* Time for which a brake at rest sticks while the current goes from i to u. */
static double holds(const brake *b, double u) {
  const double load = b->gamma * force(b), most = largest_holding(b), final = b->k_m * u - load;
  if (fabs(b->k_m * b->i - load) > most) return 0.0;
  if (fabs(final) <= most) return HUGE_VAL;
  const double gap = (load + copysign(most, final)) / b->k_m - u;
  return gap * (b->i - u) <= 0.0 ? HUGE_VAL : fmax(0.0, b->current_lag * log((b->i - u) / gap));
}

static slide begin(const brake *b, double u) {
  const double ahead = b->x2 != 0.0 ? b->x2 : b->k_m * b->i - b->gamma * force(b);
  const double direction = ahead > 0.0 ? 1.0 : -1.0, clamp = travel(b, b->x1, b->w);
  const double rate = stop_rate(b, b->w, direction);
  const int touches = clamp == 0.0 && direction > 0.0 && (b->play == 0.0 || rate == 0.0);
  const double loaded = clamp > 0.0 || touches ? 1.0 : 0.0;
  const slide a = {direction, b->x1, b->x2, b->w, b->play > 0.0 || loaded > 0.0 ? rate : 0.0, loaded, b->i, u};
  return a;
}

static void arrive(brake *b, const slide *a, step_end end, double edge, int reaches) {
  const double limit = stop_limit(b);
  b->x1 = reaches ? edge : end.x1;
  b->x2 = end.x2 * a->direction <= 0.0 ? 0.0 : end.x2;
  b->w = fmin(limit, fmax(-limit, a->w + a->rate * (end.x1 - a->x1)));
  if (reaches && b->play == 0.0) b->w = edge == 0.0 ? 0.0 : a->direction;
  else if (reaches && a->rate > 0.0) b->w = a->direction * limit;
}

static int advance(brake *b, double u, double left) {
  double longest = left;
  if (b->current_lag == 0.0) b->i = u;
  for (int n = 0; left > 0.0 && n < MOST; n++) {
    if (b->x2 == 0.0) {
      const double held = fmin(holds(b, u), left);
      b->i = held > 0.0 ? current_after(b, b->i, u, held) : b->i;
      left -= held;
      if (left <= 0.0) return 1;
    }
    const slide a = begin(b, u);
    const double edge = edge_ahead(b, a.x1, a.w, a.direction);
    double before = acceleration(b, &a, 0.0, a.x1, a.x2);
    if (a.x2 == 0.0 && before * a.direction < 0.0) before = 0.0;
    if (a.x2 == 0.0 && b->stribeck_velocity > 0.0) longest = FIRST;
    double h = fmin(left, longest);
    step_end end = runge_kutta(b, &a, before, h);
    double allowed = b->tolerance + ROUNDING * fabs(end.x2);
    while (end.error > allowed && h > SHORTEST) {
      h *= fmax(0.1, 0.9 * pow(allowed / end.error, 0.2));
      end = runge_kutta(b, &a, before, h);
      allowed = b->tolerance + ROUNDING * fabs(end.x2);
    }
    longest = h * fmin(5.0, 0.9 * pow(allowed / fmax(end.error, 1e-30), 0.2));
    if (end.a * before < 0.0) end = runge_kutta(b, &a, before, h = root(b, &a, before, h, ACCELERATION, 0.0));
    if (end.x2 * a.direction <= 0.0 && a.x2 != 0.0)
      end = runge_kutta(b, &a, before, h = root(b, &a, before, h, VELOCITY, 0.0));
    const int reaches = (end.x1 - edge) * a.direction >= 0.0;
    if (reaches && end.x1 != edge) end = runge_kutta(b, &a, before, h = root(b, &a, before, h, ANGLE, edge));
    b->i = current_after(b, b->i, u, h);
    arrive(b, &a, end, edge, reaches);
    left -= h;
  }
  return left <= 0.0;
}
