/*
 * SPDX-License-Identifier: Apache-2.0
 */

/* Any multirotor: the twin of onboard/multirotor.py, onboard/_allocation.py and onboard/_drag.py.

     velocity_of   multirotor.Multirotor._velocity
     push          multirotor.Multirotor._acceleration
     tilt          multirotor.Multirotor._tilt
     turn          multirotor.Multirotor._yaw_acceleration
     allocate      _allocation.Allocation.allocate, where no control exceeds its range
     drag          _drag.RotorDrag.step

   Python does a step in which a control exceeds its range, or the yaw passes 180 degrees. */

#include "step.h"

static const double SURE = 1.0 - 1e-12; /* [1]: no rounding error makes a shorter vector longer */
static const double BELOW_PI = 3.1;     /* [rad]: math.remainder does not change such an angle */

typedef struct {
  double plan[3], lagging[2], integral[3], yaw;
} Memory;

typedef struct { /* onboard/_twins.py has the same fields in the same order */
  /* Numbers of the controller, with the same names as in Python. */
  double dt, gravity, drag, thrust_max, slope_max, lead_max, climb_lead_max, rise_max;
  double planned_max, sink_max, up_min, heave_max, thrust_square;
  double b, climb, part, gain, gain_z, attitude, yaw_gain;
  double wind, tiny, yaw_lead_max, centre[3];
  i64 count, drags, tilted; /* actuators; whether rotors have drag; whether some are not upright */
  double columns[ACTUATORS_MAX][4]; /* control per acceleration and angular accelerations */
  double limits[ACTUATORS_MAX][2];
  double rotors[ACTUATORS_MAX][7]; /* place, axis, and drag per control and velocity */
  /* Memory, which Python reads and writes between two runs. */
  Memory memory;
} Multirotor;

/* Shorten a vector to at most a given length. */
static void shorten(const StepState *f, double *x, double *y, double length) {
  if (*x * *x + *y * *y <= length * length * SURE) return; /* as usual, without a call of Python */
  double size = f->hypot(*x, *y);
  if (size <= length) return;
  *x = *x * length / size, *y = *y * length / size;
}

static double clamp(double value, double low, double high) { /* min(max(value, low), high) */
  double least = low > value ? low : value;
  return high < least ? high : least;
}

static void velocity_of(const Multirotor *c, const Readings *r, double *velocity) {
  const double *a = r->axes, *rate = r->twist + 3, *centre = c->centre;
  double p = rate[0], q = rate[1];
  double u = q * centre[2], v = -p * centre[2], w = p * centre[1] - q * centre[0];
  for (int i = 0; i < 3; i++) velocity[i] = r->twist[i] + a[i] * u + a[3 + i] * v + a[6 + i] * w;
}

/* Compute the acceleration that the actuators must make, and advance plan and integral. */
static void push(const StepState *f, const Multirotor *c, Memory *m, const double *velocity,
                 double *acceleration) {
  double dt = c->dt, b = c->b, climb = c->climb;
  double vx = velocity[0], vy = velocity[1], vz = velocity[2];
  double rx = f->reference[0], ry = f->reference[1], rz = f->reference[2];
  double ux = m->plan[0], uy = m->plan[1], uz = m->plan[2];
  double lx = m->lagging[0], ly = m->lagging[1];
  double ix = m->integral[0], iy = m->integral[1], iz = m->integral[2];

  double planned_x = b * (rx - ux), planned_y = b * (ry - uy);
  shorten(f, &planned_x, &planned_y, c->planned_max);
  double planned_z = clamp(climb * (rz - uz), c->sink_max, c->rise_max);
  double ex = lx - vx, ey = ly - vy, ez = uz - vz;
  double ahead = ux + planned_x * dt - vx, aside = uy + planned_y * dt - vy;
  shorten(f, &ahead, &aside, c->lead_max);
  double above = clamp(uz + planned_z * dt - vz, -c->climb_lead_max, c->climb_lead_max);
  m->plan[0] = vx + ahead, m->plan[1] = vy + aside, m->plan[2] = vz + above;
  m->lagging[0] = lx + c->part * (ux - lx), m->lagging[1] = ly + c->part * (uy - ly);

  double wanted_z = planned_z + climb * ez + iz + c->gravity;
  double up = clamp(wanted_z, c->up_min, c->thrust_max);
  double wanted_x = planned_x + c->drag * ux + b * ex + ix;
  double wanted_y = planned_y + c->drag * uy + b * ey + iy;
  double most = up * c->slope_max, left = sqrt(c->thrust_square - up * up);
  ahead = wanted_x, aside = wanted_y;
  shorten(f, &ahead, &aside, left < most ? left : most);

  if (up == wanted_z) iz = clamp(iz + c->gain_z * ez * dt, -c->heave_max, c->heave_max);
  if (ahead == wanted_x && aside == wanted_y) {
    ix = ix + c->gain * ex * dt, iy = iy + c->gain * ey * dt;
    shorten(f, &ix, &iy, c->wind);
  }
  m->integral[0] = ix, m->integral[1] = iy, m->integral[2] = iz;
  acceleration[0] = ahead, acceleration[1] = aside, acceleration[2] = up;
}

/* Compute the thrust and the angular accelerations about x and y. */
static void tilt(const StepState *f, const Multirotor *c, const Readings *r,
                 const double *acceleration, double *wanted) {
  const double *a = r->axes, *rate = r->twist + 3;
  double ax = acceleration[0], ay = acceleration[1], az = acceleration[2];
  double ahead = ax * a[0] + ay * a[1] + az * a[2];
  double aside = ax * a[3] + ay * a[4] + az * a[5];
  double thrust = ax * a[6] + ay * a[7] + az * a[8];
  double across = f->hypot(ahead, aside), angle = f->atan2(across, thrust);
  double roll = angle, pitch = 0.0, b = c->attitude;
  if (across > c->tiny) roll = -angle * aside / across, pitch = angle * ahead / across;
  wanted[0] = thrust;
  wanted[1] = b * (b * roll - 2.0 * rate[0]);
  wanted[2] = b * (b * pitch - 2.0 * rate[1]);
}

/* Advance the yaw reference, and compute the angular acceleration about z; return 0 if the yaw
   passes 180 degrees. */
static int turn(const StepState *f, const Multirotor *c, Memory *m, const Readings *r,
                double *wanted) {
  double yaw = f->atan2(r->axes[1], r->axes[0]);
  double lead = m->yaw + f->yaw_rate * c->dt - yaw, b = c->yaw_gain;
  if (!(-BELOW_PI < lead && lead < BELOW_PI)) return 0;
  lead = clamp(lead, -c->yaw_lead_max, c->yaw_lead_max);
  m->yaw = yaw + lead;
  *wanted = b * (b * lead + 2.0 * (f->yaw_rate - r->twist[5]));
  return 1;
}

/* Compute the controls; return 0 if one exceeds its range. */
static int allocate(const Multirotor *c, const double *wanted, double *commands) {
  for (i64 i = 0; i < c->count; i++) {
    const double *k = c->columns[i], *limits = c->limits[i];
    double command = k[0] * wanted[0] + k[1] * wanted[1] + k[2] * wanted[2] + k[3] * wanted[3];
    if (!(limits[0] <= command && command <= limits[1])) return 0;
    commands[i] = command;
  }
  return 1;
}

static void drag(StepState *f, const Multirotor *c, const Readings *r) {
  const double *a = r->axes, *velocity = r->twist, *rate = r->twist + 3;
  double p = rate[0], q = rate[1], s = rate[2], v[3], force[3] = {0.0}, torque[3] = {0.0};
  for (int i = 0; i < 3; i++)
    v[i] = a[3 * i] * velocity[0] + a[3 * i + 1] * velocity[1] + a[3 * i + 2] * velocity[2];
  for (i64 i = 0; i < c->count; i++) {
    const double *k = c->rotors[i], x = k[0], y = k[1], z = k[2];
    double scale = -k[6] * (f->speeds[i] < 0.0 ? -f->speeds[i] : f->speeds[i]);
    double hub_x = v[0] + q * z - s * y, hub_y = v[1] + s * x - p * z;
    if (!c->tilted) { /* without the part along the axis, which is 0 */
      double fx = scale * hub_x, fy = scale * hub_y;
      force[0] += fx, force[1] += fy;
      torque[0] -= z * fy, torque[1] += z * fx, torque[2] += x * fy - y * fx;
      continue;
    }
    double hub_z = v[2] + p * y - q * x;
    double along = hub_x * k[3] + hub_y * k[4] + hub_z * k[5];
    double fx = scale * (hub_x - along * k[3]);
    double fy = scale * (hub_y - along * k[4]);
    double fz = scale * (hub_z - along * k[5]);
    force[0] += fx, force[1] += fy, force[2] += fz;
    torque[0] += y * fz - z * fy, torque[1] += z * fx - x * fz, torque[2] += x * fy - y * fx;
  }
  for (int i = 0; i < 3; i++) {
    f->applied[i] = a[i] * force[0] + a[3 + i] * force[1] + a[6 + i] * force[2];
    f->applied[3 + i] = torque[i];
  }
}

static int update(const StepState *f, Multirotor *c, const Readings *r, double *commands) {
  Memory next = c->memory;
  double velocity[3], acceleration[3], wanted[4];
  velocity_of(c, r, velocity);
  push(f, c, &next, velocity, acceleration);
  if (!turn(f, c, &next, r, &wanted[3])) return 0;
  tilt(f, c, r, acceleration, wanted);
  if (!allocate(c, wanted, commands)) return 0;
  c->memory = next;
  return 1;
}

int cloudrc_multirotor(StepState *f, const Readings *r) {
  Multirotor *c = f->controller;
  double commands[ACTUATORS_MAX];
  if (!f->is_off && !update(f, c, r, commands)) return 0;
  for (i64 i = 0; i < c->count; i++)
    f->ctrl[i] = f->speeds[i] = f->is_off ? f->stopped[i] : commands[i];
  if (c->drags)
    drag(f, c, r);
  else
    for (int i = 0; i < 6; i++) f->applied[i] = 0.0;
  return 1;
}
