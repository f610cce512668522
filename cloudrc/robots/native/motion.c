/*
 * SPDX-License-Identifier: Apache-2.0
 */

/* Predict the robot's motion: one call for all commands of a horizon, and one for a whole plan.

   This file is the twin of Python code, as step.c is, with the same rules:

     advance       motion.WhiteBox.advance
     limit         motion._limit
     cloudrc_plan  control loop's ControlLoop._plan, with controllers.pid.Pid.update

   motion.py has the sources of all formulas and numbers. */

typedef long long i64;
double sqrt(double);

/* Shared with Python: motion.py has the same numbers in the same order. */
typedef struct {
  /* Constants of the Python modules motion, low_level, rotors and guard.limits. */
  double step, robot_mass, robot_gravity, weight, inertia_x, inertia_y, lag, up, down;
  double drag, thrust_max, tilt_rate_gain, floor_margin, low_height, low_speed, sink_lead_max;
  double gain_p[3], gain_i[3], gain_d[3], integral_limit[3], acceleration_max;
  /* State. */
  double missed[3], trim[2];
  double reference[3], integral[3], thrust, torque[2];
  double position[3], velocity[3], axis[2], rate[2];
} Body;

typedef struct {
  double position[3], velocity[3], moves; /* moves: whether the velocity is added */
} Goal;

typedef struct {
  double gain_p[3], gain_d[3], has_derivative;
  double velocity[3], dt, most; /* the first command; time of a step; limit of a component */
} Law;

static void limit(const Body *b, double *reference, double climb, double height) {
  double x = reference[0], y = reference[1], z = reference[2];
  double least = b->reference[2], sinking = climb - b->sink_lead_max;
  if (sinking < least) least = sinking;
  if (least > z) z = least;
  if (z < 0.0) {
    double room = height - b->floor_margin;
    if (0.0 > room) room = 0.0;
    least = -2.0 * room / (0.2 + sqrt(0.04 + room / 1.5));
    if (least > z) z = least;
  }
  double speed = sqrt(x * x + y * y);
  double scale = height < b->low_height && speed > b->low_speed ? b->low_speed / speed : 1.0;
  reference[0] = scale * x, reference[1] = scale * y, reference[2] = z;
}

static void advance(Body *b, const double *command, double dt) {
  double parts = dt / b->step - 1e-9;
  i64 steps = (i64)parts;
  steps += (double)steps < parts;
  double h = dt / (double)steps;
  double lag = h / (h + b->lag), up = h / (h + b->up), down = h / (h + b->down);
  double change = b->acceleration_max * h;
  double *p = b->position, *v = b->velocity, *n = b->axis, *rate = b->rate, *torque = b->torque;
  for (i64 k = 0; k < steps; k++) {
    double reference[3] = {command[0], command[1], command[2]};
    double *last = b->reference, way[3], force[3], acceleration[3];
    for (int i = 0; i < 3; i++) way[i] = command[i] - last[i];
    double square = way[0] * way[0] + way[1] * way[1] + way[2] * way[2];
    if (!(square <= change * change)) {
      double share = change / sqrt(square);
      for (int i = 0; i < 3; i++) reference[i] = last[i] + share * way[i];
    }
    if (p[2] < b->low_height || reference[2] < 0.0) limit(b, reference, v[2], p[2]);
    double across = n[0] * n[0] + n[1] * n[1];
    if (across > 1.0) {
      double size = sqrt(across);
      n[0] = n[0] / size, n[1] = n[1] / size, across = 1.0;
    }
    double nx = n[0], ny = n[1], nz = sqrt(1.0 - across);
    double along = b->thrust / b->robot_mass + b->drag * (v[0] * nx + v[1] * ny + v[2] * nz);
    acceleration[0] = along * nx - b->drag * v[0] + b->missed[0];
    acceleration[1] = along * ny - b->drag * v[1] + b->missed[1];
    acceleration[2] = along * nz - b->drag * v[2] + b->missed[2] - b->robot_gravity;
    for (int i = 0; i < 3; i++) {
      double e = reference[i] - v[i], most = b->integral_limit[i], s = b->integral[i] + e * h;
      s = s > most ? most : s < -most ? -most : s;
      b->integral[i] = s;
      force[i] = b->gain_p[i] * e + b->gain_i[i] * s;
      force[i] = force[i] + b->gain_d[i] * ((reference[i] - last[i]) / h - acceleration[i]);
    }
    force[2] = force[2] + b->weight;
    for (int i = 0; i < 3; i++) last[i] = reference[i];
    double fx = force[0], fy = force[1], fz = force[2];
    double wanted = fx * nx + fy * ny + fz * nz;
    if (0.0 > wanted) wanted = 0.0;
    if (b->thrust_max < wanted) wanted = b->thrust_max;
    b->thrust += (wanted - b->thrust) * (wanted > b->thrust ? up : down);
    double size = sqrt(fx * fx + fy * fy + fz * fz);
    if (size == 0.0) size = 1.0;
    double tilt = b->tilt_rate_gain;
    torque[0] += lag * ((fx * nz - fz * nx) / size - tilt * rate[0] - torque[0]);
    torque[1] += lag * ((fy * nz - fz * ny) / size - tilt * rate[1] - torque[1]);
    rate[0] += h * (torque[0] + b->trim[0]) / b->inertia_y;
    rate[1] += h * (torque[1] + b->trim[1]) / b->inertia_x;
    n[0] += h * rate[0] * nz;
    n[1] += h * rate[1] * nz;
    for (int i = 0; i < 3; i++) {
      p[i] += h * (v[i] + 0.5 * h * acceleration[i]);
      v[i] += h * acceleration[i];
    }
  }
}

/* Advance under `count` commands: each a velocity and how long it lasts. If `states` is not null,
   write position and velocity after each of them. */
void cloudrc_advance(Body *b, const double *commands, i64 count, double *states) {
  for (const double *each = commands; each < commands + 4 * count; each += 4) {
    advance(b, each, each[3]);
    if (!states) continue;
    for (int i = 0; i < 3; i++) states[i] = b->position[i], states[3 + i] = b->velocity[i];
    states += 6;
  }
}

/* Plan for `count` goals. Write the velocities of the plan, in single precision as datagrams have
   them, and behind these the positions in which they were computed. Return the number of velocities
   before the first one with a component that is not at most `most`. */
i64 cloudrc_plan(Body *b, const Law *law, const Goal *goals, i64 count, double *plan) {
  double velocity[3], *positions = plan + 3 * count;
  for (int i = 0; i < 3; i++) velocity[i] = law->velocity[i];
  for (i64 k = 0; k < count; k++) {
    const Goal *goal = goals + k;
    advance(b, velocity, law->dt);
    int fits = 1;
    for (int i = 0; i < 3; i++) {
      double u = law->gain_p[i] * (goal->position[i] - b->position[i]);
      if (law->has_derivative)
        u = u + 0.0 + law->gain_d[i] * (goal->velocity[i] - b->velocity[i]);
      if (goal->moves) u = u + goal->velocity[i];
      velocity[i] = u;
      plan[3 * k + i] = (float)u, positions[3 * k + i] = b->position[i];
      fits = fits && (u < 0.0 ? -u : u) <= law->most;
    }
    if (!fits) return k;
  }
  return count;
}
