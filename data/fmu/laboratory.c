/* A laboratory as a unit of co-simulation (FMI 3.0): hands values to a Python process, which flies the scene, and back.

   1. fmi3EnterInitializationMode starts the process; the first output that is asked for, or the end of that mode, a flight.
   2. fmi3DoStep sends the inputs and a number of control periods, and receives all variables.
   3. fmi3Terminate and fmi3FreeInstance close the socket, upon which the process ends; fmi3Reset begins anew.

   variables.h is generated with the unit: the table of its variables, their start values, and the process to start.
   A value takes a cell of eight bytes. A message is three numbers of eight bytes (what, periods, status) and the cells;
   an answer with another status than fmi3OK is two numbers (status, length) and a text. */

#define _GNU_SOURCE
#include <errno.h>
#include <math.h>
#include <signal.h>
#include <spawn.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>

#include "fmi3Functions.h"

typedef union {
    double real;
    int64_t whole;
} Cell;

typedef struct {
    char type; /* d: Float64, q: Int64, ?: Boolean */
    const char *causality;
    size_t size; /* number of its cells */
} Variable;

#include "variables.h"

enum { COUNT = sizeof VARIABLES / sizeof VARIABLES[0], TEXT = 2048, END_MS = 5000 };
enum { BEGIN, STEP };

typedef enum { INSTANTIATED, INITIALIZATION, STEPS, ENDED, BROKEN } State;

typedef struct {
    State state;
    int is_stale; /* whether the outputs are those of other parameters or inputs */
    int socket;   /* to the process; -1 without */
    pid_t process;
    int64_t periods;
    char *script;
    fmi3InstanceEnvironment environment;
    fmi3LogMessageCallback log;
    Cell cells[CELLS];
} Laboratory;

/* Tell the host what is wrong; the status is returned. */
static fmi3Status fail(Laboratory *lab, fmi3Status status, const char *format, ...) {
    char text[TEXT];
    va_list values;
    va_start(values, format);
    vsnprintf(text, sizeof text, format, values);
    va_end(values);
    if (lab->log)
        lab->log(lab->environment, status, "logStatusError", text);
    return status;
}

/* The process. */

static int transfer(Laboratory *lab, int sends, void *data, size_t length) {
    char *at = data;
    while (length) {
        /* Without MSG_NOSIGNAL the end of the process would end the host too. */
        ssize_t done = sends ? send(lab->socket, at, length, MSG_NOSIGNAL) : recv(lab->socket, at, length, 0);
        if (done < 0 && errno == EINTR)
            continue;
        if (done <= 0)
            return 0;
        at += done;
        length -= (size_t)done;
    }
    return 1;
}

static void stop(Laboratory *lab) {
    if (lab->socket < 0)
        return;
    close(lab->socket);
    lab->socket = -1;
    struct timespec pause = {0, 10 * 1000 * 1000};
    for (int waited_ms = 0; waitpid(lab->process, NULL, WNOHANG) == 0; waited_ms += 10) {
        if (waited_ms == END_MS)
            kill(lab->process, SIGKILL);
        nanosleep(&pause, NULL);
    }
}

extern char **environ;

/* The environment of the host without what it has set for libraries and a Python of its own. */
static char **own_environment(void) {
    static const char *const LEFT_OUT[] = {"LD_LIBRARY_PATH=", "LD_PRELOAD=", "PYTHONHOME=", "PYTHONPATH="};
    size_t count = 0;
    while (environ[count])
        count++;
    char **kept = calloc(count + 1, sizeof *kept);
    for (size_t n = 0, at = 0; kept && n < count; n++) {
        int is_left_out = 0;
        for (size_t k = 0; k < sizeof LEFT_OUT / sizeof LEFT_OUT[0]; k++)
            is_left_out |= strncmp(environ[n], LEFT_OUT[k], strlen(LEFT_OUT[k])) == 0;
        if (!is_left_out)
            kept[at++] = environ[n];
    }
    return kept;
}

static fmi3Status start(Laboratory *lab) {
    if (lab->socket >= 0)
        return fmi3OK;
    const char *python = getenv("SKYSIM_PYTHON") ? getenv("SKYSIM_PYTHON") : PYTHON;
    int ends[2];
    if (socketpair(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0, ends))
        return fail(lab, fmi3Error, "no socket: %s", strerror(errno));
    /* The socket is the process's standard input; what it prints goes to standard error. */
    posix_spawn_file_actions_t actions;
    posix_spawn_file_actions_init(&actions);
    posix_spawn_file_actions_adddup2(&actions, ends[1], 0);
    posix_spawn_file_actions_adddup2(&actions, 2, 1);
    char *words[] = {(char *)python, lab->script, NULL};
    char **variables = own_environment();
    int error = posix_spawnp(&lab->process, python, &actions, NULL, words, variables ? variables : environ);
    posix_spawn_file_actions_destroy(&actions);
    free(variables);
    close(ends[1]);
    if (error) {
        close(ends[0]);
        return fail(lab, fmi3Error, "%s: %s; SKYSIM_PYTHON may name a Python with skysim", python, strerror(error));
    }
    lab->socket = ends[0];
    return fmi3OK;
}

/* Send what is to be done, with all variables, and receive all variables. */
static fmi3Status exchange(Laboratory *lab, int64_t what, int64_t periods) {
    int64_t request[2] = {what, periods};
    int64_t answer[2];
    char text[TEXT] = "";
    int is_whole = transfer(lab, 1, request, sizeof request) && transfer(lab, 1, lab->cells, sizeof lab->cells) &&
                   transfer(lab, 0, answer, sizeof answer);
    if (is_whole && answer[0] == fmi3OK)
        is_whole = transfer(lab, 0, lab->cells, sizeof lab->cells);
    else if (is_whole)
        is_whole = answer[1] < TEXT && transfer(lab, 0, text, (size_t)answer[1]);
    if (!is_whole) {
        stop(lab);
        lab->state = BROKEN;
        return fail(lab, fmi3Error, "the process of the laboratory has ended; its standard error says why");
    }
    if (answer[0] != fmi3OK) {
        lab->state = BROKEN;
        return fail(lab, fmi3Error, "%s", text);
    }
    return fmi3OK;
}

/* Bring the outputs of the beginning up to date. */
static fmi3Status settle(Laboratory *lab) {
    if (lab->state != INITIALIZATION || !lab->is_stale)
        return fmi3OK;
    fmi3Status status = exchange(lab, BEGIN, 0);
    lab->is_stale = status != fmi3OK;
    return status;
}

/* Life of an instance. */

const char *fmi3GetVersion(void) { return "3.0"; }

fmi3Status fmi3SetDebugLogging(fmi3Instance instance, fmi3Boolean on, size_t count, const fmi3String categories[]) {
    (void)instance, (void)on, (void)count, (void)categories;
    return fmi3OK;
}

static void make_new(Laboratory *lab) {
    lab->state = INSTANTIATED;
    lab->is_stale = 1;
    lab->periods = 0;
    memcpy(lab->cells, STARTS, sizeof lab->cells);
}

fmi3Instance fmi3InstantiateCoSimulation(
    fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible, fmi3Boolean logs,
    fmi3Boolean uses_events, fmi3Boolean returns_early, const fmi3ValueReference intermediate[], size_t count,
    fmi3InstanceEnvironment environment, fmi3LogMessageCallback log, fmi3IntermediateUpdateCallback update) {
    (void)name, (void)visible, (void)logs, (void)uses_events, (void)returns_early, (void)intermediate, (void)count;
    (void)update;
    static const char SCRIPT[] = "/laboratory_slave.py";
    Laboratory *lab = calloc(1, sizeof *lab);
    if (!lab)
        return NULL;
    lab->socket = -1;
    lab->environment = environment;
    lab->log = log;
    if (!token || strcmp(token, TOKEN))
        fail(lab, fmi3Error, "the instantiation token is that of another unit");
    else if (!resources)
        fail(lab, fmi3Error, "no path of the resources");
    else if ((lab->script = malloc(strlen(resources) + sizeof SCRIPT)))
        strcat(strcpy(lab->script, resources), SCRIPT);
    if (!lab->script) {
        free(lab);
        return NULL;
    }
    make_new(lab);
    return lab;
}

void fmi3FreeInstance(fmi3Instance instance) {
    Laboratory *lab = instance;
    if (!lab)
        return;
    stop(lab);
    free(lab->script);
    free(lab);
}

fmi3Status fmi3EnterInitializationMode(fmi3Instance instance, fmi3Boolean has_tolerance, fmi3Float64 tolerance,
                                       fmi3Float64 begin_s, fmi3Boolean has_end, fmi3Float64 end_s) {
    (void)has_tolerance, (void)tolerance, (void)has_end, (void)end_s;
    Laboratory *lab = instance;
    if (lab->state != INSTANTIATED)
        return fail(lab, fmi3Error, "initialization: the unit has begun; allowed: after fmi3Reset");
    if (begin_s != 0)
        return fail(lab, fmi3Error, "start time: %g s; allowed: 0", begin_s);
    fmi3Status status = start(lab);
    lab->state = status == fmi3OK ? INITIALIZATION : BROKEN;
    return status;
}

fmi3Status fmi3ExitInitializationMode(fmi3Instance instance) {
    Laboratory *lab = instance;
    if (lab->state != INITIALIZATION)
        return fail(lab, fmi3Error, "fmi3ExitInitializationMode: not in this mode");
    fmi3Status status = settle(lab);
    if (status == fmi3OK)
        lab->state = STEPS;
    return status;
}

fmi3Status fmi3DoStep(fmi3Instance instance, fmi3Float64 now_s, fmi3Float64 step_s, fmi3Boolean keeps_state,
                      fmi3Boolean *has_event, fmi3Boolean *is_over, fmi3Boolean *is_early, fmi3Float64 *reached_s) {
    (void)keeps_state;
    Laboratory *lab = instance;
    int64_t periods = llround(step_s / PERIOD_S);
    double before_s = (double)lab->periods * PERIOD_S;
    *has_event = *is_over = *is_early = fmi3False;
    *reached_s = before_s;
    if (lab->state != STEPS)
        return fail(lab, fmi3Error, "fmi3DoStep: the unit is not initialized, or has failed");
    if (periods < 1 || !(fabs(step_s - (double)periods * PERIOD_S) < 1e-3 * PERIOD_S))
        return fail(lab, fmi3Error, "step: %.17g s; allowed: multiples of the control period, %.17g s", step_s, PERIOD_S);
    if (!(fabs(now_s - before_s) < 1e-3 * PERIOD_S))
        return fail(lab, fmi3Error, "time of the step: %.17g s; allowed: %.17g s, where the unit is", now_s, before_s);
    fmi3Status status = exchange(lab, STEP, periods);
    if (status != fmi3OK)
        return status;
    lab->periods += periods;
    *reached_s = (double)lab->periods * PERIOD_S;
    return fmi3OK;
}

fmi3Status fmi3Terminate(fmi3Instance instance) {
    Laboratory *lab = instance;
    stop(lab);
    lab->state = ENDED;
    return fmi3OK;
}

fmi3Status fmi3Reset(fmi3Instance instance) {
    make_new(instance);
    return fmi3OK;
}

/* Variables. */

/* The variables that are named, if they are of a type and have as many values as are given; else NULL, and a message. */
static const Variable *variable(Laboratory *lab, fmi3ValueReference reference, char type, size_t left) {
    if (reference >= COUNT || VARIABLES[reference].type != type)
        fail(lab, fmi3Error, "variable %u: there is none of this type", (unsigned)reference);
    else if (VARIABLES[reference].size > left)
        fail(lab, fmi3Error, "variable %u: %zu values; too few are left", (unsigned)reference, VARIABLES[reference].size);
    else
        return &VARIABLES[reference];
    return NULL;
}

static int is_settable(const Laboratory *lab, const Variable *one) {
    int is_before = lab->state == INSTANTIATED || lab->state == INITIALIZATION;
    return (!strcmp(one->causality, "parameter") && is_before) ||
           (!strcmp(one->causality, "input") && (is_before || lab->state == STEPS));
}

/* The cells of a variable, which lie in the order of the table. */
static Cell *cells(Laboratory *lab, const Variable *one) {
    Cell *first = lab->cells;
    for (const Variable *before = VARIABLES; before < one; before++)
        first += before->size;
    return first;
}

#define ACCESS(NAME, TYPE, CODE, MEMBER)                                                                               \
    fmi3Status fmi3Get##NAME(fmi3Instance instance, const fmi3ValueReference references[], size_t count, TYPE values[], \
                             size_t value_count) {                                                                     \
        Laboratory *lab = instance;                                                                                    \
        size_t at = 0;                                                                                                 \
        fmi3Status status = settle(lab);                                                                               \
        for (size_t n = 0; n < count && status == fmi3OK; n++) {                                                       \
            const Variable *one = variable(lab, references[n], CODE, value_count - at);                                \
            if (!one)                                                                                                  \
                return fmi3Error;                                                                                      \
            for (size_t k = 0; k < one->size; k++)                                                                     \
                values[at++] = (TYPE)cells(lab, one)[k].MEMBER;                                                        \
        }                                                                                                              \
        return status;                                                                                                 \
    }                                                                                                                  \
    fmi3Status fmi3Set##NAME(fmi3Instance instance, const fmi3ValueReference references[], size_t count,               \
                             const TYPE values[], size_t value_count) {                                                \
        Laboratory *lab = instance;                                                                                    \
        size_t at = 0;                                                                                                 \
        for (size_t n = 0; n < count; n++) {                                                                           \
            const Variable *one = variable(lab, references[n], CODE, value_count - at);                                \
            if (!one)                                                                                                  \
                return fmi3Error;                                                                                      \
            if (!is_settable(lab, one))                                                                                \
                return fail(lab, fmi3Error, "variable %u: not to be set now; allowed: inputs, and parameters before"    \
                            " the first step", (unsigned)references[n]);                                               \
            for (size_t k = 0; k < one->size; k++)                                                                     \
                cells(lab, one)[k].MEMBER = values[at++];                                                              \
            lab->is_stale = 1;                                                                                         \
        }                                                                                                              \
        return fmi3OK;                                                                                                 \
    }

ACCESS(Float64, fmi3Float64, 'd', real)
ACCESS(Int64, fmi3Int64, 'q', whole)
ACCESS(Boolean, fmi3Boolean, '?', whole)

/* What the model description does not offer. These functions ignore their other arguments. */

__attribute__((used)) static fmi3Status refused(fmi3Instance instance) {
    return fail(instance, fmi3Error, "a function that this unit does not have");
}

__attribute__((used)) static fmi3Instance no_instance(void) { return NULL; }

#pragma GCC diagnostic ignored "-Wattribute-alias"
#define REFUSED(NAME) FMI3_Export NAME##TYPE NAME __attribute__((alias("refused")));

FMI3_Export fmi3InstantiateModelExchangeTYPE fmi3InstantiateModelExchange __attribute__((alias("no_instance")));
FMI3_Export fmi3InstantiateScheduledExecutionTYPE fmi3InstantiateScheduledExecution
    __attribute__((alias("no_instance")));
REFUSED(fmi3EnterEventMode)
REFUSED(fmi3GetFloat32)
REFUSED(fmi3GetInt8)
REFUSED(fmi3GetUInt8)
REFUSED(fmi3GetInt16)
REFUSED(fmi3GetUInt16)
REFUSED(fmi3GetInt32)
REFUSED(fmi3GetUInt32)
REFUSED(fmi3GetUInt64)
REFUSED(fmi3GetString)
REFUSED(fmi3GetBinary)
REFUSED(fmi3GetClock)
REFUSED(fmi3SetFloat32)
REFUSED(fmi3SetInt8)
REFUSED(fmi3SetUInt8)
REFUSED(fmi3SetInt16)
REFUSED(fmi3SetUInt16)
REFUSED(fmi3SetInt32)
REFUSED(fmi3SetUInt32)
REFUSED(fmi3SetUInt64)
REFUSED(fmi3SetString)
REFUSED(fmi3SetBinary)
REFUSED(fmi3SetClock)
REFUSED(fmi3GetNumberOfVariableDependencies)
REFUSED(fmi3GetVariableDependencies)
REFUSED(fmi3GetFMUState)
REFUSED(fmi3SetFMUState)
REFUSED(fmi3FreeFMUState)
REFUSED(fmi3SerializedFMUStateSize)
REFUSED(fmi3SerializeFMUState)
REFUSED(fmi3DeserializeFMUState)
REFUSED(fmi3GetDirectionalDerivative)
REFUSED(fmi3GetAdjointDerivative)
REFUSED(fmi3EnterConfigurationMode)
REFUSED(fmi3ExitConfigurationMode)
REFUSED(fmi3GetIntervalDecimal)
REFUSED(fmi3GetIntervalFraction)
REFUSED(fmi3GetShiftDecimal)
REFUSED(fmi3GetShiftFraction)
REFUSED(fmi3SetIntervalDecimal)
REFUSED(fmi3SetIntervalFraction)
REFUSED(fmi3SetShiftDecimal)
REFUSED(fmi3SetShiftFraction)
REFUSED(fmi3EvaluateDiscreteStates)
REFUSED(fmi3UpdateDiscreteStates)
REFUSED(fmi3EnterContinuousTimeMode)
REFUSED(fmi3CompletedIntegratorStep)
REFUSED(fmi3SetTime)
REFUSED(fmi3SetContinuousStates)
REFUSED(fmi3GetContinuousStateDerivatives)
REFUSED(fmi3GetEventIndicators)
REFUSED(fmi3GetContinuousStates)
REFUSED(fmi3GetNominalsOfContinuousStates)
REFUSED(fmi3GetNumberOfEventIndicators)
REFUSED(fmi3GetNumberOfContinuousStates)
REFUSED(fmi3EnterStepMode)
REFUSED(fmi3GetOutputDerivatives)
REFUSED(fmi3ActivateModelPartition)
