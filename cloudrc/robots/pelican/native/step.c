/*
 * SPDX-License-Identifier: Apache-2.0
 */

/* Fly the robot in the usual case: a fresh command that the guard need not limit.

   This file is the twin of Python code, and gives the same bits. The Python code is the reference:
   it has the sources of all formulas and numbers, and it flies the robot in every other case.

     read          readings.Readings.of
     guard_step    guard.state.Guard.step, for a robot in TRACK with a fresh command
     is_far        guard.limits.limit_to_fence, where it changes nothing
     update        low_level.LowLevel.update
     turn_rotors   rotors.Rotors.step, simulator.Simulator.step
     feel          simulator.Simulator._feel

   Where nothing can touch the robot, `step_physics` lets MuJoCo look for no contacts.

   Every sum and product has the order of the Python code. Compile without contraction of
   a * b + c, and without fast-math. The only function from outside, apart from mj_step, is sqrt,
   which IEEE 754 defines to the last bit. No header is included: a small compiler without headers
   has to suffice. All quantities have the units of the Python code. */

typedef long long i64;
static const double ROOM = 1e-6; /* [m]: no rounding error matters, the fence limits nothing */
double sqrt(double);

/* Shared with Python: robot.py has the same fields, all of 8 bytes, in the same order. */
typedef struct { /* a box with rounded edges that contains a geom of the scene */
  double centre[3], axes[9], half[3], radius;
} Obstacle;

typedef struct {
  /* MuJoCo: mj_step, its arguments, and arrays and numbers of mjData. */
  void (*mj_step)(const void *model, void *data);
  const void *model, *free_model; /* free_model: without what a robot in free air does not need */
  void *data;
  const double *qpos, *qvel;
  double *ctrl, *applied;
  const double *tip_force;
  const int *contacts;
  double (**timer)(void); /* mjcb_time, which mj_step calls to measure its parts */
  const Obstacle *obstacles;
  /* Constants of the Python modules rotors, low_level and guard, with the same names. */
  double thrust_coefficient, torque_ratio, drag_coefficient, arm, height;
  double mass, gravity, tilt_gain, yaw_gain, tilt_rate_gain, yaw_rate_gain;
  double thrust_max, tiny, nose_cosine_min, yaw_sine_max;
  double overturned_cosine, sink_lead_max;
  double fence_reaction, reaction, stop_coefficient;
  /* Values of this robot: gains and limits of the controller, corners of the fence, and so on. */
  double up, down, gains[9], limit_xy, limit_z, dt;
  double change_max, low[3], high[3];
  double time_step, robot_radius, acceleration_max;
  i64 step_ns, check_steps, obstacle_count;
  /* State, which Python reads and writes between two runs. */
  i64 now_ns, until_ns; /* time of the next step, and end of the run */
  double reference[3], wanted[3];
  i64 track_until_ns;
  double force_peak, impulse;
  i64 touching, steps, is_news; /* number of contacts; whether Python has to look at them */
  i64 free_steps; /* steps without contact that are sure; below 0: steps until the next look */
  double speeds[4], integral[3], error[3];
  i64 has_error;
  double before[13]; /* position, orientation and velocities at the beginning of the last step */
} StepState;

typedef struct {
  double pose[7], twist[6], axes[9];
} Readings;

static void read(const StepState *f, Readings *r) {
  for (int i = 0; i < 7; i++) r->pose[i] = f->qpos[i];
  for (int i = 0; i < 6; i++) r->twist[i] = f->qvel[i];
  double w = r->pose[3], x = r->pose[4], y = r->pose[5], z = r->pose[6];
  double x2 = x + x, y2 = y + y, z2 = z + z;
  double wx = w * x2, wy = w * y2, wz = w * z2;
  double xx = x * x2, xy = x * y2, xz = x * z2;
  double yy = y * y2, yz = y * z2, zz = z * z2;
  double *a = r->axes;
  a[0] = 1.0 - yy - zz, a[1] = xy + wz, a[2] = xz - wy;
  a[3] = xy - wz, a[4] = 1.0 - xx - zz, a[5] = yz + wx;
  a[6] = xz + wy, a[7] = yz - wx, a[8] = 1.0 - xx - yy;
}

/* Tell whether the fence does not limit the velocity at the position. */
static int is_far(const StepState *f, const double *velocity, const double *position) {
  for (int i = 0; i < 3; i++) {
    double low = f->low[i], high = f->high[i], v = velocity[i];
    double reaction = i == 2 ? f->reaction : f->fence_reaction; /* towards the lower face */
    if (v > 0.0)
      high -= v * (f->fence_reaction + v * f->stop_coefficient);
    else
      low -= v * (reaction - v * f->stop_coefficient);
    if (!(low + ROOM <= position[i] && position[i] <= high - ROOM)) return 0;
  }
  return 1;
}

/* Move the reference by one step; return 0, with nothing changed, if Python has to do this step. */
static int guard_step(StepState *f, const Readings *r, i64 now_ns) {
  if (r->axes[8] < f->overturned_cosine || now_ns > f->track_until_ns) return 0;
  const double *from = f->reference, *to = f->wanted;
  double x = to[0] - from[0], y = to[1] - from[1], z = to[2] - from[2];
  double square = x * x + y * y + z * z;
  int settles = square <= f->change_max * f->change_max;
  double share = settles ? 0.0 : f->change_max / sqrt(square);
  double moved[3] = {from[0] + share * x, from[1] + share * y, from[2] + share * z};
  const double *reference = settles ? to : moved;
  if (reference[2] < r->twist[2] - f->sink_lead_max) return 0;
  if (!is_far(f, reference, r->pose)) return 0;
  for (int i = 0; i < 3; i++) f->reference[i] = reference[i];
  return 1;
}

static double speed_of(const StepState *f, double thrust) {
  double t = thrust < 0.0 ? 0.0 : thrust;
  return sqrt((t > f->thrust_max ? f->thrust_max : t) / f->thrust_coefficient);
}

static void update(StepState *f, const Readings *r, double *commands) {
  const double *g = f->gains, *a = r->axes, *rate = r->twist + 3;
  double force[3];
  for (int i = 0; i < 3; i++) {
    double e = f->reference[i] - r->twist[i], last = f->has_error ? f->error[i] : e;
    double limit = i == 2 ? f->limit_z : f->limit_xy, s = f->integral[i] + e * f->dt;
    s = s > limit ? limit : s < -limit ? -limit : s;
    f->error[i] = e, f->integral[i] = s;
    force[i] = g[i] * e + g[3 + i] * s + g[6 + i] * (e - last);
  }
  f->has_error = 1;
  double fx = force[0], fy = force[1], fz = force[2] + f->mass * f->gravity;

  double thrust = fx * a[6] + fy * a[7] + fz * a[8];
  double across = fy * fy + fz * fz, size = sqrt(fx * fx + across), scale;
  scale = 1.0 / (size != 0.0 ? size : f->tiny);
  double z0 = scale * (fx * a[0] + fy * a[1] + fz * a[2]);
  double z1 = scale * (fx * a[3] + fy * a[4] + fz * a[5]);
  double z2 = scale * thrust;
  size = sqrt(across);
  scale = 1.0 / (size != 0.0 ? size : f->tiny);
  double y0 = scale * (fz * a[1] - fy * a[2]);
  double y1 = scale * (fz * a[4] - fy * a[5]);
  double y2 = scale * (fz * a[7] - fy * a[8]);
  double roll = y2 - z1, pitch = z0 + y1 * z0 - y0 * z1, yaw;
  if (y1 < f->nose_cosine_min || a[1] > f->yaw_sine_max || a[1] < -f->yaw_sine_max)
    roll = -z1 - z1, pitch = z0 + z0;
  roll = 0.5 * f->tilt_gain * roll - f->tilt_rate_gain * rate[0];
  pitch = 0.5 * f->tilt_gain * pitch - f->tilt_rate_gain * rate[1];
  yaw = 0.5 * f->yaw_gain * (y2 * z0 - y0 * z2 - y0) - f->yaw_rate_gain * rate[2];

  roll = roll / (2.0 * f->arm), pitch = pitch / (2.0 * f->arm);
  yaw = yaw / (4.0 * f->torque_ratio);
  double share = 0.25 * thrust, with_yaw = share + yaw, against_yaw = share - yaw;
  double thrusts[4] = {with_yaw - pitch, against_yaw + roll, with_yaw + pitch, against_yaw - roll};
  int plain = thrust <= f->thrust_max;
  for (int i = 0; i < 4; i++) plain = plain && thrusts[i] >= 0.0;
  for (int i = 0; i < 4; i++)
    commands[i] = plain ? sqrt(thrusts[i] / f->thrust_coefficient) : speed_of(f, thrusts[i]);
}

static void turn_rotors(StepState *f, const Readings *r, const double *commands) {
  const double *a = r->axes, *v = r->twist, *rate = r->twist + 3;
  double *s = f->speeds;
  for (int i = 0; i < 4; i++) s[i] += (commands[i] - s[i]) * (commands[i] > s[i] ? f->up : f->down);

  double total = f->drag_coefficient * (s[0] + s[1] + s[2] + s[3]);
  double drag_arm = f->drag_coefficient * f->arm;
  double across_x = drag_arm * (s[0] - s[2]), across_y = drag_arm * (s[1] - s[3]);
  double u = a[0] * v[0] + a[1] * v[1] + a[2] * v[2] + rate[1] * f->height;
  double w = a[3] * v[0] + a[4] * v[1] + a[5] * v[2] - rate[0] * f->height;
  double force_x = across_y * rate[2] - total * u;
  double force_y = -across_x * rate[2] - total * w;
  for (int i = 0; i < 4; i++) f->ctrl[i] = f->thrust_coefficient * s[i] * s[i];
  for (int i = 0; i < 3; i++) f->applied[i] = a[i] * force_x + a[3 + i] * force_y;
  f->applied[3] = -f->height * force_y;
  f->applied[4] = f->height * force_x;
  f->applied[5] = across_y * u - across_x * w - f->arm * f->arm * total * rate[2];
}

/* Measure the tip's force, and note in is_news whether Python has to look at the contacts. */
static void feel(StepState *f) {
  i64 contacts = *f->contacts, before = f->touching;
  f->is_news = 0;
  if (!contacts && !before) return;
  double force = *f->tip_force;
  f->impulse += force * f->time_step;
  if (force > f->force_peak) f->force_peak = force;
  f->is_news = contacts && (contacts != before || f->steps % f->check_steps == 0);
  f->touching = contacts;
}

/* Return for how many steps nothing can touch a ball around the robot. The speed grows by at most
   acceleration_max. */
static i64 free_steps(const StepState *f, const double *position, const double *velocity) {
  double nearest = 1e6, speed = 0.0, most = f->acceleration_max;
  for (const Obstacle *o = f->obstacles; o < f->obstacles + f->obstacle_count; o++) {
    double square = 0.0;
    for (int axis = 0; axis < 3; axis++) {
      double along = 0.0;
      for (int i = 0; i < 3; i++) along += o->axes[3 * i + axis] * (position[i] - o->centre[i]);
      double beyond = (along < 0.0 ? -along : along) - o->half[axis];
      if (beyond > 0.0) square += beyond * beyond;
    }
    double distance = sqrt(square) - o->radius;
    if (distance < nearest) nearest = distance;
  }
  nearest -= f->robot_radius;
  if (!(nearest > 0.0)) return 0;
  for (int i = 0; i < 3; i++) speed += velocity[i] * velocity[i];
  speed = sqrt(speed);
  double duration = (sqrt(speed * speed + 2.0 * most * nearest) - speed) / most;
  i64 steps = (i64)(duration / f->time_step) - 1;
  return steps > 100 ? 100 : steps;
}

/* Do a step of MuJoCo. While nothing can touch the robot, MuJoCo need not look for contacts. This
   changes no bit of the result, and takes half the time. */
static void step_physics(StepState *f, const Readings *r) {
  if (f->free_steps == 0 && !f->touching) {
    f->free_steps = free_steps(f, r->pose, r->twist);
    if (f->free_steps <= 0) f->free_steps = -5;
  }
  f->mj_step(f->free_steps > 0 ? f->free_model : f->model, f->data);
  f->free_steps += f->free_steps < 0 ? 1 : f->free_steps > 0 ? -1 : 0;
}

/* Run steps from now_ns up to until_ns [ns]; return their number, and move now_ns on. The run ends
   early before a step that Python has to do, and after a step with new contacts. */
i64 cloudrc_run(StepState *f) {
  i64 steps = 0;
  double (*timer)(void) = *f->timer;
  *f->timer = 0;
  f->is_news = 0;
  for (; f->now_ns < f->until_ns && !f->is_news; f->now_ns += f->step_ns) {
    Readings r;
    double commands[4];
    read(f, &r);
    if (!guard_step(f, &r, f->now_ns)) break;
    for (int i = 0; i < 7; i++) f->before[i] = r.pose[i];
    for (int i = 0; i < 6; i++) f->before[7 + i] = r.twist[i];
    update(f, &r, commands);
    turn_rotors(f, &r, commands);
    step_physics(f, &r);
    f->steps++, steps++;
    feel(f);
  }
  *f->timer = timer;
  return steps;
}
