/*
 * SPDX-License-Identifier: Apache-2.0
 */

/* What the steps in C share: with Python (robot.py has the same fields, all of 8 bytes, in the same
   order), and with each other.

   Every sum and product has the order of the Python code. Compile without contraction of
   a * b + c, and without fast-math. The only functions from outside are mj_step, those that Python
   hands over, and sqrt, which IEEE 754 defines to the last bit. No header of the C library is
   included: a small compiler without headers has to suffice. All quantities have the units of the
   Python code. */

typedef long long i64;
double sqrt(double);

enum { ACTUATORS_MAX = 16 }; /* largest number of actuators of a robot */

typedef struct {
  double pose[7], twist[6], axes[9];
} Readings;

typedef struct { /* a box with rounded edges that contains a geom of the scene */
  double centre[3], axes[9], half[3], radius;
} Obstacle;

typedef struct StepState StepState;
struct StepState {
  /* MuJoCo: mj_step, its arguments, and arrays and numbers of mjData. */
  void (*mj_step)(const void *model, void *data);
  const void *model, *free_model; /* free_model: without what a robot in free air does not need */
  void *data;
  const double *qpos, *qvel;
  double *ctrl, *applied;
  const double *probe_force;
  const int *contacts;
  /* The first contact's pair of geoms, place, and whether it is none; 0 while nobody knows where.
     The next contact is contact_size bytes further. */
  const char *contact_geoms, *contact_place, *contact_excluded;
  const i64 *bodies; /* of each geom: the number of its body, 0 for the robot's */
  i64 *touched;      /* of each body: step of the last contact without the probe, and with it */
  const double *probe; /* place of the probe; 0 without one */
  double (**timer)(void); /* mjcb_time, which mj_step calls to measure its parts */
  const Obstacle *obstacles;
  /* What computes the actuators in a step, with its own block of numbers and memory. It returns 0,
     with nothing changed, if Python has to do this step. */
  int (*control)(StepState *, const Readings *);
  void *controller;
  /* Python's math.hypot and math.atan2: their last bit depends on the versions of Python and of the
     C library. */
  double (*hypot)(double, double), (*atan2)(double, double);
  /* Constants of the Python modules of the guard, with the same names. */
  double overturned_cosine, sink_lead_max, fence_reaction, reaction;
  double far, return_gain, return_speed_max, low_speed;
  /* Values of this robot: its braking, corners of the fence, and so on. */
  double stop_coefficient;
  double change_max, low[3], high[3];
  double low_height; /* height below which the horizontal speed is limited to low_speed */
  double lift_off;   /* change of the height with which the robot has left the ground */
  double time_step, robot_radius, acceleration_max, probe_radius;
  i64 step_ns, check_steps, obstacle_count, gap_steps, contact_size;
  double stopped[ACTUATORS_MAX]; /* commands to the actuators of a robot that is switched off */
  /* State. Python writes the next numbers before each run. */
  i64 is_off, is_over;  /* whether the robot is switched off; whether it has left the ground */
  double ground;        /* height at which the robot stood */
  i64 now_ns, until_ns; /* time of the next step, and end of the run */
  i64 track_until_ns;
  double wanted[3], yaw_rate;
  /* Python reads the next numbers after each run, and writes them after steps of its own. */
  double force_peak, impulse, reference[3];
  i64 touching, steps, is_news; /* number of contacts; whether Python has to look at them */
  i64 free_steps; /* steps without contact that are sure; below 0: steps until the next look */
  double speeds[ACTUATORS_MAX]; /* what the actuators do */
  double before[13]; /* position, orientation and velocities at the beginning of the last step */
};
