/* Inner loops that are slow in numpy and scipy. Each one duplicates a few lines of Python, which run where there is no
 * compiler, and is tested against them. Only the sizes of buffers are checked, not the indices in them.
 */
#define PY_SSIZE_T_CLEAN
#define Py_LIMITED_API 0x030B0000
#include <Python.h>
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#define MOST_TAPS 6

/* None, or NULL with a ValueError that says why not. */
static PyObject *none_if(int fits, const char *why)
{
    if (fits)
        Py_RETURN_NONE;
    PyErr_SetString(PyExc_ValueError, why);
    return NULL;
}

/* Weights of the taps of a B-spline of degree 3 or 5, at the fraction t after the tap degree / 2. */
static void spline_weights(int degree, double t, double *weight)
{
    double t2 = t * t, t3 = t2 * t, s = 1.0 - t;
    if (degree == 3) {
        weight[0] = s * s * s / 6.0;
        weight[1] = (4.0 - 6.0 * t2 + 3.0 * t3) / 6.0;
        weight[2] = (1.0 + 3.0 * t + 3.0 * t2 - 3.0 * t3) / 6.0;
        weight[3] = t3 / 6.0;
        return;
    }
    double t4 = t2 * t2, t5 = t4 * t;
    weight[0] = s * s * s * s * s / 120.0;
    weight[1] = (26.0 - 50.0 * t + 20.0 * t2 + 20.0 * t3 - 20.0 * t4 + 5.0 * t5) / 120.0;
    weight[2] = (66.0 - 60.0 * t2 + 30.0 * t4 - 10.0 * t5) / 120.0;
    weight[3] = (26.0 + 50.0 * t + 20.0 * t2 - 20.0 * t3 - 20.0 * t4 + 10.0 * t5) / 120.0;
    weight[4] = (1.0 + 5.0 * t + 10.0 * t2 + 10.0 * t3 + 5.0 * t4 - 5.0 * t5) / 120.0;
    weight[5] = t5 / 120.0;
}

/* Mirror an index at the first or last one. Once suffices: places lie at most a few taps outside. */
static Py_ssize_t mirrored(Py_ssize_t index, Py_ssize_t size)
{
    if (index < 0)
        index = -index;
    if (index >= size)
        index = 2 * size - 2 - index;
    return index;
}

static double spline_value(const double *coefficients, Py_ssize_t height, Py_ssize_t width, int degree, double row,
                           double column)
{
    double down[MOST_TAPS], along[MOST_TAPS], value = 0.0;
    double above = floor(row), left = floor(column);
    int taps = degree + 1;
    Py_ssize_t row0 = (Py_ssize_t)above - degree / 2, column0 = (Py_ssize_t)left - degree / 2;
    spline_weights(degree, row - above, down);
    spline_weights(degree, column - left, along);
    if (row0 >= 0 && column0 >= 0 && row0 + taps <= height && column0 + taps <= width) {
        const double *at = coefficients + row0 * width + column0;
        for (int i = 0; i < taps; i++, at += width) {
            double sum = 0.0;
            for (int j = 0; j < taps; j++)
                sum += along[j] * at[j];
            value += down[i] * sum;
        }
        return value;
    }
    for (int i = 0; i < taps; i++) {
        const double *at = coefficients + mirrored(row0 + i, height) * width;
        double sum = 0.0;
        for (int j = 0; j < taps; j++)
            sum += along[j] * at[mirrored(column0 + j, width)];
        value += down[i] * sum;
    }
    return value;
}

/* spline_samples(coefficients, width, rows, columns, degree, samples) -> clamped
 *
 * Evaluate a spline with coefficients (height, width) at places (n,). Values are rounded half to even and clamped to
 * the range of the samples: 8 or 16 bits, by the item size of their buffer. Returns the number of clamped values.
 */
static PyObject *spline_samples(PyObject *module, PyObject *args)
{
    Py_buffer coefficients, rows, columns, samples;
    Py_ssize_t width, clamped = 0;
    int degree;
    if (!PyArg_ParseTuple(args, "y*ny*y*iw*", &coefficients, &width, &rows, &columns, &degree, &samples))
        return NULL;
    Py_ssize_t height = width > 0 ? coefficients.len / (Py_ssize_t)sizeof(double) / width : 0;
    Py_ssize_t count = rows.len / (Py_ssize_t)sizeof(double), item = count ? samples.len / count : 1;
    int fits = (degree == 3 || degree == 5) && height > degree && width > degree && columns.len == rows.len &&
               height * width * (Py_ssize_t)sizeof(double) == coefficients.len && count * item == samples.len &&
               (item == 1 || item == 2);
    if (fits) {
        const double *row = rows.buf, *column = columns.buf;
        double highest = item == 1 ? 255.0 : 65535.0, reach_rows = (double)height, reach_columns = (double)width;
        Py_BEGIN_ALLOW_THREADS
        for (Py_ssize_t i = 0; i < count; i++) {
            double value = 0.0;
            if (row[i] > -2.0 && row[i] < reach_rows + 1.0 && column[i] > -2.0 && column[i] < reach_columns + 1.0)
                value = rint(spline_value(coefficients.buf, height, width, degree, row[i], column[i]));
            if (value < 0.0 || value > highest) {
                clamped++;
                value = value < 0.0 ? 0.0 : highest;
            }
            if (item == 1)
                ((uint8_t *)samples.buf)[i] = (uint8_t)value;
            else
                ((uint16_t *)samples.buf)[i] = (uint16_t)value;
        }
        Py_END_ALLOW_THREADS
    }
    PyBuffer_Release(&coefficients);
    PyBuffer_Release(&rows);
    PyBuffer_Release(&columns);
    PyBuffer_Release(&samples);
    const char *fault = "the sizes of coefficients, places and samples do not go together";
    return fits ? PyLong_FromSsize_t(clamped) : none_if(0, fault);
}

/* Elimination of small blocks of unknowns. */

#define MOST_OWN 3

/* Array of eight-byte items with up to three dimensions; steps are strides in items. */
typedef struct {
    Py_buffer view;
    Py_ssize_t length[3], step[3];
} Table;

/* Open the tables of all arguments, writable from number `output` on. dimensions: one character per argument, a digit
 * for a C-contiguous array of so many dimensions, a letter (a for 1, b for 2, c for 3) for one with any strides.
 */
static int open_tables(PyObject *args, const char *dimensions, int output, Table *tables)
{
    int count = (int)strlen(dimensions), opened = 0;
    if (PyTuple_Size(args) != count) {
        PyErr_SetString(PyExc_TypeError, "another number of arguments");
        return 0;
    }
    for (; opened < count; opened++) {
        Table *table = tables + opened;
        int any = dimensions[opened] >= 'a', axes = dimensions[opened] - (any ? 'a' - 1 : '0');
        int flags = (any ? PyBUF_STRIDES : PyBUF_C_CONTIGUOUS) | (opened < output ? 0 : PyBUF_WRITABLE);
        if (PyObject_GetBuffer(PyTuple_GetItem(args, opened), &table->view, flags) < 0)
            break;
        if (table->view.itemsize != 8 || table->view.ndim != axes) {
            PyErr_SetString(PyExc_ValueError, "an array of another kind");
            PyBuffer_Release(&table->view);
            break;
        }
        for (int axis = 0; axis < axes; axis++) {
            table->length[axis] = table->view.shape[axis];
            table->step[axis] = table->view.strides[axis] / 8;
        }
    }
    if (opened == count)
        return 1;
    while (opened--)
        PyBuffer_Release(&tables[opened].view);
    return 0;
}

/* Element of a table of doubles with any strides. */
static inline double element(const Table *table, int64_t i, int64_t j, int64_t k)
{
    return ((const double *)table->view.buf)[i * table->step[0] + j * table->step[1] + k * table->step[2]];
}

static inline double *place_of(const Table *table, int64_t i, int64_t j)
{
    return (double *)table->view.buf + i * table->step[0] + j * table->step[1];
}

/* One column of a pair of rows of a matrix (n, 2, k). */
static inline void take_pair(const Table *matrix, int64_t row, int64_t column, double *x, double *y)
{
    const double *at = (const double *)matrix->view.buf + row * matrix->step[0] + column * matrix->step[2];
    *x = at[0];
    *y = at[matrix->step[1]];
}

static void close_tables(Table *tables, int count)
{
    for (int i = 0; i < count; i++)
        PyBuffer_Release(&tables[i].view);
}

/* Orthonormalise consecutive columns of `height` elements (modified Gram-Schmidt); fills the upper triangle R. */
static void make_orthonormal(double *columns, int count, Py_ssize_t height, double triangle[MOST_OWN][MOST_OWN])
{
    for (int i = 0; i < count; i++) {
        double *column = columns + i * height, square = 0.0;
        for (Py_ssize_t k = 0; k < height; k++)
            square += column[k] * column[k];
        double length = sqrt(square), over = length > 0.0 ? 1.0 / length : 0.0;
        for (Py_ssize_t k = 0; k < height; k++)
            column[k] *= over;
        triangle[i][i] = length;
        for (int j = i + 1; j < count; j++) {
            double *other = columns + j * height, along = 0.0;
            for (Py_ssize_t k = 0; k < height; k++)
                along += column[k] * other[k];
            for (Py_ssize_t k = 0; k < height; k++)
                other[k] -= along * column[k];
            triangle[i][j] = along;
        }
    }
}

/* A front: its normal (or cofactor) matrix, with only the lower triangle used, and the place of each unknown in it. */
typedef struct {
    double *square;
    int64_t width;
    int32_t *place;
    int64_t number;
} Front;

#define INTEGERS(table) ((const int64_t *)(table).view.buf)
#define DOUBLES(table) ((double *)(table).view.buf)

/* Select a front. A row of the table of fronts: first unknown, number of own unknowns, offset of the matrix in squares,
 * offset of the later unknowns in after, and their number.
 */
static void open_front(Front *front, int64_t number, const Table *fronts, const Table *after, double *squares)
{
    if (front->number == number)
        return;
    const int64_t *row = INTEGERS(*fronts) + 5 * number;
    for (int64_t i = 0; i < row[1]; i++)
        front->place[row[0] + i] = (int32_t)i;
    for (int64_t i = 0; i < row[4]; i++)
        front->place[INTEGERS(*after)[row[3] + i]] = (int32_t)(row[1] + i);
    front->square = squares + row[2];
    front->width = row[1] + row[4];
    front->number = number;
}

/* square_rows(matrix, right, columns, order, first, unknowns, sequence, home, fronts, after, squares, shared) -> None */
static PyObject *square_rows(PyObject *module, PyObject *args)
{
    enum { MATRIX, RIGHT, COLUMNS, ORDER, FIRST, UNKNOWNS, SEQUENCE, HOME, FRONTS, AFTER, SQUARES, SHARED, TABLES };
    Table t[TABLES];
    if (!open_tables(args, "c21112112111", SQUARES, t))
        return NULL;
    int64_t n = t[MATRIX].length[0], cells = t[UNKNOWNS].length[0], width = t[UNKNOWNS].length[1];
    int fits = t[MATRIX].length[1] == 2 && t[RIGHT].length[0] == n && t[RIGHT].length[1] == 2 &&
               t[COLUMNS].length[0] == width && t[FIRST].length[0] == cells + 1 && t[HOME].length[0] == cells &&
               t[SEQUENCE].length[0] == cells && t[FRONTS].length[1] == 5;
    Front front = {NULL, 0, malloc(((size_t)t[SHARED].length[0] + 1) * sizeof(int32_t)), -1};
    double *row = malloc(2 * ((size_t)width + 1) * sizeof(double));
    double *sums = malloc(((size_t)width + 1) * ((size_t)width + 1) * sizeof(double));
    int ready = fits && front.place && row && sums;
    if (ready) {
        Py_BEGIN_ALLOW_THREADS
        double *x = row, *y = row + width + 1, *shared = DOUBLES(t[SHARED]);
        for (int64_t i = 0; i < cells; i++) {
            int64_t cell = INTEGERS(t[SEQUENCE])[i];
            const int64_t *unknown = INTEGERS(t[UNKNOWNS]) + cell * width;
            open_front(&front, INTEGERS(t[HOME])[cell], &t[FRONTS], &t[AFTER], DOUBLES(t[SQUARES]));
            memset(sums, 0, (size_t)(width + 1) * (size_t)(width + 1) * sizeof(double));
            for (int64_t r = INTEGERS(t[FIRST])[cell]; r < INTEGERS(t[FIRST])[cell + 1]; r++) {
                int64_t at = INTEGERS(t[ORDER])[r];
                for (int64_t j = 0; j < width; j++)
                    take_pair(&t[MATRIX], at, INTEGERS(t[COLUMNS])[j], x + j, y + j);
                x[width] = DOUBLES(t[RIGHT])[2 * at];
                y[width] = DOUBLES(t[RIGHT])[2 * at + 1];
                for (int64_t j = 0; j <= width; j++) {
                    double *sum = sums + j * (width + 1), by_x = x[j], by_y = y[j];
                    for (int64_t k = 0; k <= j; k++)
                        sum[k] += by_x * x[k] + by_y * y[k];
                }
            }
            for (int64_t j = 0; j < width; j++) {
                if (unknown[j] < 0)
                    continue;
                int64_t one = front.place[unknown[j]];
                shared[unknown[j]] += sums[width * (width + 1) + j];
                for (int64_t k = 0; k <= j; k++) {
                    if (unknown[k] < 0)
                        continue;
                    int64_t other = front.place[unknown[k]];
                    front.square[one > other ? one * front.width + other : other * front.width + one] +=
                        sums[j * (width + 1) + k];
                }
            }
        }
        Py_END_ALLOW_THREADS
    }
    free(front.place);
    free(row);
    free(sums);
    close_tables(t, TABLES);
    return none_if(ready, "the sizes of rows and cells do not go together");
}

/* The border (o, s) of a block, its shared unknowns sorted by their places in the front, and the first indices of the
 * runs of consecutive places.
 */
typedef struct {
    int64_t count, runs, *run;
    int32_t *place;
    int64_t *unknown;
    double *row[MOST_OWN];
} Border;

/* Tables that define the borders of blocks, and memory for the largest border. */
typedef struct {
    const Table *first, *numbers, *members, *singles, *parts, *alone;
    int64_t own, group, single_count;
    Border border;
    Front front;
} Borders;

static int make_room(Borders *b, int64_t shared_count)
{
    int64_t most = 0;
    b->own = b->parts->length[1], b->group = b->parts->length[2], b->single_count = b->singles->length[0];
    for (int64_t i = 0; i + 1 < b->first->length[0]; i++) {
        int64_t rows = INTEGERS(*b->first)[i + 1] - INTEGERS(*b->first)[i];
        most = rows > most ? rows : most;
    }
    size_t width = (size_t)(most * b->group + b->single_count + 1);
    b->front = (Front){NULL, 0, malloc(((size_t)shared_count + 1) * sizeof(int32_t)), -1};
    b->border.place = malloc(width * sizeof(int32_t));
    b->border.unknown = malloc(width * sizeof(int64_t));
    b->border.run = malloc((width + 1) * sizeof(int64_t));
    b->border.row[0] = malloc(MOST_OWN * width * sizeof(double));
    if (!b->front.place || !b->border.place || !b->border.unknown || !b->border.run ||
        !b->border.row[0])
        return 0;
    for (int k = 1; k < MOST_OWN; k++)
        b->border.row[k] = b->border.row[0] + (size_t)k * width;
    return 1;
}

static void give_back(Borders *b)
{
    free(b->front.place);
    free(b->border.place);
    free(b->border.unknown);
    free(b->border.run);
    free(b->border.row[0]);
}

static void insert(Borders *b, int64_t unknown, const double *value, int64_t step)
{
    Border *border = &b->border;
    int32_t place = b->front.place[unknown];
    int64_t at = border->count++;
    for (; at > 0 && border->place[at - 1] > place; at--) {
        border->place[at] = border->place[at - 1];
        border->unknown[at] = border->unknown[at - 1];
        for (int k = 0; k < MOST_OWN; k++)
            border->row[k][at] = border->row[k][at - 1];
    }
    border->place[at] = place;
    border->unknown[at] = unknown;
    for (int64_t k = 0; k < MOST_OWN; k++)
        border->row[k][at] = k < b->own ? value[k * step] : 0.0;
}

/* Assemble the border of a block from the parts in its groups and in the single unknowns. numbers (m,): group of each
 * pair of rows.
 */
static void lay_out_border(Borders *b, int64_t block)
{
    b->border.count = 0;
    for (int64_t i = INTEGERS(*b->first)[block]; i < INTEGERS(*b->first)[block + 1]; i++) {
        const int64_t *members = INTEGERS(*b->members) + INTEGERS(*b->numbers)[i] * b->group;
        for (int64_t j = 0; j < b->group; j++)
            if (members[j] >= 0)
                insert(b, members[j], DOUBLES(*b->parts) + i * b->own * b->group + j, b->group);
    }
    for (int64_t s = 0; s < b->single_count; s++)
        insert(b, INTEGERS(*b->singles)[s], DOUBLES(*b->alone) + block * b->own * b->single_count + s,
               b->single_count);
    Border *border = &b->border;
    border->runs = 0;
    for (int64_t j = 0; j < border->count; j++)
        if (j == 0 || border->place[j] != border->place[j - 1] + 1)
            border->run[border->runs++] = j;
    border->run[border->runs] = border->count;
}

enum {
    MATRIX, RIGHT, ORDER, FIRST, SEQUENCE, HOME, BY_OWN, BY_GROUP, BY_SINGLE, OWN, GROUP, MEMBERS, SINGLE, SINGLES,
    WEIGHT, PRIOR, FRONTS, AFTER, TRIANGLE, REDUCED, ORTHONORMAL, PARTS, ALONE, SQUARES, SHARED, TABLES
};

/* Tables and working memory of an elimination. rank: index of a shared unknown among the single ones. */
typedef struct {
    Table t[TABLES];
    int64_t own, group, single, singles, m;
    double *orthonormal, *unused; /* unused: dummy target for rows of a border beyond o */
    int32_t *rank;
    Borders borders;
} Elimination;

/* Eliminate the own unknowns of a block by orthonormalising their columns: fills triangle, right side and border. */
static void eliminate_block(Elimination *e, int64_t block)
{
    int64_t begin = INTEGERS(e->t[FIRST])[block], rows = INTEGERS(e->t[FIRST])[block + 1] - begin;
    int64_t o = e->own, height = 2 * rows + o;
    const int64_t *order = INTEGERS(e->t[ORDER]) + begin, *own = INTEGERS(e->t[OWN]) + block * o;
    double *q = e->orthonormal, first[MOST_OWN][MOST_OWN], second[MOST_OWN][MOST_OWN];
    double *reduced = DOUBLES(e->t[REDUCED]) + block * o, *alone = DOUBLES(e->t[ALONE]) + block * o * e->singles;
    for (int64_t k = 0; k < o; k++) {
        double *column = q + k * height;
        for (int64_t i = 0; i < rows; i++) {
            take_pair(&e->t[MATRIX], order[i], INTEGERS(e->t[BY_OWN])[k], column + 2 * i, column + 2 * i + 1);
            if (own[k] < 0)
                column[2 * i] = column[2 * i + 1] = 0.0;
        }
        for (int64_t j = 0; j < o; j++)
            column[2 * rows + j] = j == k ? DOUBLES(e->t[WEIGHT])[block * o + k] : 0.0;
    }
    make_orthonormal(q, (int)o, height, first);
    make_orthonormal(q, (int)o, height, second); /* twice is enough (Giraud, Langou and Rozloznik 2005) */
    memset(alone, 0, (size_t)(o * e->singles) * sizeof(double));
    for (int64_t k = 0; k < o; k++) {
        reduced[k] = 0.0;
        for (int64_t j = 0; j < o; j++) {
            double sum = 0.0;
            for (int64_t i = k; i <= j; i++)
                sum += second[k][i] * first[i][j];
            DOUBLES(e->t[TRIANGLE])[(block * o + k) * o + j] = sum;
            reduced[k] += q[k * height + 2 * rows + j] * DOUBLES(e->t[PRIOR])[block * o + j];
        }
    }
    for (int64_t i = 0; i < rows; i++) {
        const double *right = DOUBLES(e->t[RIGHT]) + 2 * order[i];
        double x[MOST_OWN] = {0.0}, y[MOST_OWN] = {0.0}, *part[MOST_OWN] = {e->unused, e->unused, e->unused};
        for (int64_t k = 0; k < o; k++) {
            x[k] = q[k * height + 2 * i];
            y[k] = q[k * height + 2 * i + 1];
            part[k] = DOUBLES(e->t[PARTS]) + ((begin + i) * o + k) * e->group;
            reduced[k] += x[k] * right[0] + y[k] * right[1];
            DOUBLES(e->t[ORTHONORMAL])[2 * k * e->m + begin + i] = x[k];
            DOUBLES(e->t[ORTHONORMAL])[(2 * k + 1) * e->m + begin + i] = y[k];
        }
        for (int64_t j = 0; j < e->group; j++) {
            double by_x, by_y;
            take_pair(&e->t[MATRIX], order[i], INTEGERS(e->t[BY_GROUP])[j], &by_x, &by_y);
            part[0][j] = x[0] * by_x + y[0] * by_y;
            part[1][j] = x[1] * by_x + y[1] * by_y;
            part[2][j] = x[2] * by_x + y[2] * by_y;
        }
        for (int64_t j = 0; j < e->single; j++) {
            int64_t unknown = INTEGERS(e->t[SINGLE])[order[i] * e->single + j];
            double by_x, by_y;
            if (unknown < 0)
                continue;
            take_pair(&e->t[MATRIX], order[i], INTEGERS(e->t[BY_SINGLE])[j], &by_x, &by_y);
            for (int64_t k = 0; k < o; k++)
                alone[k * e->singles + e->rank[unknown]] += x[k] * by_x + y[k] * by_y;
        }
    }
}

/* Reduce the normal equations of the shared unknowns: subtract B'B, and B' times the reduced right side. */
static void subtract_border(Elimination *e, int64_t block)
{
    const Border *border = &e->borders.border;
    const double *reduced = DOUBLES(e->t[REDUCED]) + block * e->own;
    const double *b0 = border->row[0], *b1 = border->row[1], *b2 = border->row[2];
    for (int64_t i = 0; i < border->count; i++) {
        double *into = e->borders.front.square + border->place[i] * e->borders.front.width;
        double a0 = b0[i], a1 = b1[i], a2 = b2[i];
        for (int64_t k = 0; k < e->own; k++)
            DOUBLES(e->t[SHARED])[border->unknown[i]] -= border->row[k][i] * reduced[k];
        for (int64_t run = 0; run < border->runs && border->run[run] <= i; run++) {
            int64_t first = border->run[run], stop = border->run[run + 1] <= i ? border->run[run + 1] : i + 1;
            double *restrict to = into + border->place[first];
            const double *restrict c0 = b0 + first, *restrict c1 = b1 + first, *restrict c2 = b2 + first;
            for (int64_t j = 0; j < stop - first; j++)
                to[j] -= a0 * c0[j] + a1 * c1[j] + a2 * c2[j];
        }
        for (int64_t j = i; j-- > 0 && border->place[j] == border->place[i];) /* twice the same unknown */
            into[border->place[j]] -= a0 * b0[j] + a1 * b1[j] + a2 * b2[j];
    }
}

static const char *prepare(Elimination *e)
{
    const Table *t = e->t;
    int64_t blocks = t[OWN].length[0], n = t[MATRIX].length[0], most = 0;
    e->m = t[ORDER].length[0], e->own = t[OWN].length[1];
    e->group = t[BY_GROUP].length[0], e->single = t[BY_SINGLE].length[0], e->singles = t[SINGLES].length[0];
    if (e->own > MOST_OWN || t[MATRIX].length[1] != 2 || t[RIGHT].length[0] != n || t[RIGHT].length[1] != 2 ||
        t[GROUP].length[0] != e->m || t[SINGLE].length[0] != n || t[SINGLE].length[1] != e->single ||
        t[FIRST].length[0] != blocks + 1 || t[SEQUENCE].length[0] != blocks || t[HOME].length[0] != blocks ||
        t[MEMBERS].length[1] != e->group || t[TRIANGLE].length[0] != blocks || t[REDUCED].length[0] != blocks ||
        t[ALONE].length[0] != blocks || t[ALONE].length[2] != e->singles || t[WEIGHT].length[0] != blocks ||
        t[PRIOR].length[0] != blocks || t[PARTS].length[0] != e->m || t[PARTS].length[1] != e->own ||
        t[PARTS].length[2] != e->group || t[ORTHONORMAL].length[2] != e->m || t[FRONTS].length[1] != 5)
        return "the sizes of rows, blocks and groups do not go together";
    for (int64_t i = 0; i < blocks; i++) {
        int64_t rows = INTEGERS(t[FIRST])[i + 1] - INTEGERS(t[FIRST])[i];
        most = rows > most ? rows : most;
    }
    e->orthonormal = malloc((2 * (size_t)most + MOST_OWN) * MOST_OWN * sizeof(double));
    e->unused = malloc(((size_t)e->group + 1) * sizeof(double));
    e->rank = calloc((size_t)t[SHARED].length[0] + 1, sizeof(int32_t));
    e->borders = (Borders){.first = t + FIRST, .numbers = t + GROUP, .members = t + MEMBERS, .singles = t + SINGLES,
                           .parts = t + PARTS, .alone = t + ALONE};
    if (!make_room(&e->borders, t[SHARED].length[0]) || !e->orthonormal || !e->unused || !e->rank)
        return "no memory for the blocks";
    for (int64_t i = 0; i < e->singles; i++)
        e->rank[INTEGERS(t[SINGLES])[i]] = (int32_t)i;
    return NULL;
}

/* eliminate_blocks(...) -> None: see compiled/__init__.py. */
static PyObject *eliminate_blocks(PyObject *module, PyObject *args)
{
    Elimination e = {0};
    if (!open_tables(args, "c211111112122122213233311", TRIANGLE, e.t))
        return NULL;
    const char *fault = prepare(&e);
    if (!fault) {
        Py_BEGIN_ALLOW_THREADS
        for (int64_t i = 0; i < e.t[SEQUENCE].length[0]; i++) {
            int64_t block = INTEGERS(e.t[SEQUENCE])[i];
            open_front(&e.borders.front, INTEGERS(e.t[HOME])[block], &e.t[FRONTS], &e.t[AFTER],
                       DOUBLES(e.t[SQUARES]));
            eliminate_block(&e, block);
            lay_out_border(&e.borders, block);
            subtract_border(&e, block);
        }
        Py_END_ALLOW_THREADS
    }
    free(e.orthonormal);
    free(e.unused);
    free(e.rank);
    give_back(&e.borders);
    close_tables(e.t, TABLES);
    return none_if(!fault, fault);
}

/* border_cofactors(first, sequence, home, group, members, singles, parts, alone, fronts, after, squares, cofactors)
 *
 * Contribution of the shared unknowns to the cofactor matrices of the own ones: B Q B' for borders B, into cofactors
 * (b, o, o). Q: cofactor matrix of the shared unknowns, lower triangles of the fronts.
 */
static PyObject *border_cofactors(PyObject *module, PyObject *args)
{
    enum { FIRST, SEQUENCE, HOME, GROUP, MEMBERS, SINGLES, PARTS, ALONE, FRONTS, AFTER, SQUARES, COFACTORS, TABLES };
    Table t[TABLES];
    if (!open_tables(args, "111121332113", COFACTORS, t))
        return NULL;
    int64_t blocks = t[FIRST].length[0] - 1, shared = 0;
    int fits = t[SEQUENCE].length[0] == blocks && t[HOME].length[0] == blocks && t[ALONE].length[0] == blocks &&
               t[GROUP].length[0] == t[PARTS].length[0] && t[MEMBERS].length[1] == t[PARTS].length[2] &&
               t[ALONE].length[2] == t[SINGLES].length[0] && t[COFACTORS].length[0] == blocks &&
               t[PARTS].length[1] <= MOST_OWN && t[FRONTS].length[1] == 5;
    for (int64_t i = 0; i < t[FRONTS].length[0]; i++)
        shared += INTEGERS(t[FRONTS])[5 * i + 1];
    Borders b = {.first = t + FIRST, .numbers = t + GROUP, .members = t + MEMBERS, .singles = t + SINGLES,
                 .parts = t + PARTS, .alone = t + ALONE};
    int ready = make_room(&b, shared) && fits;
    if (ready) {
        Py_BEGIN_ALLOW_THREADS
        for (int64_t i = 0; i < blocks; i++) {
            int64_t block = INTEGERS(t[SEQUENCE])[i];
            double sums[MOST_OWN][MOST_OWN] = {{0.0}};
            open_front(&b.front, INTEGERS(t[HOME])[block], &t[FRONTS], &t[AFTER], DOUBLES(t[SQUARES]));
            lay_out_border(&b, block);
            const double *b0 = b.border.row[0], *b1 = b.border.row[1], *b2 = b.border.row[2];
            for (int64_t j = 0; j < b.border.count; j++) {
                const double *row = b.front.square + b.border.place[j] * b.front.width;
                double half = 0.5 * row[b.border.place[j]];
                double along[MOST_OWN] = {half * b0[j], half * b1[j], half * b2[j]};
                for (int64_t k = 0; k < j; k++) {
                    double cofactor = row[b.border.place[k]];
                    along[0] += cofactor * b0[k];
                    along[1] += cofactor * b1[k];
                    along[2] += cofactor * b2[k];
                }
                for (int k = 0; k < MOST_OWN; k++)
                    for (int l = 0; l < MOST_OWN; l++)
                        sums[k][l] += b.border.row[k][j] * along[l] + along[k] * b.border.row[l][j];
            }
            for (int64_t k = 0; k < b.own; k++)
                for (int64_t l = 0; l < b.own; l++)
                    DOUBLES(t[COFACTORS])[(block * b.own + k) * b.own + l] = sums[k][l];
        }
        Py_END_ALLOW_THREADS
    }
    give_back(&b);
    close_tables(t, TABLES);
    return none_if(ready, "the sizes of borders and fronts do not go together");
}

/* target_rays(values, exterior, place, image, rotation, ray, in_camera) -> None
 *
 * Fill ray (m, 2): -U/W and -V/W, and in_camera (m, 3): U, V, W of object points in camera axes. place (m, 3), exterior
 * (images, 3 or more): positions in values of the object coordinates and the projection centres.
 */
static PyObject *target_rays(PyObject *module, PyObject *args)
{
    enum { VALUES, EXTERIOR, PLACE, IMAGE, ROTATION, RAY, IN_CAMERA, TABLES };
    Table t[TABLES] = {0};
    if (!open_tables(args, "1221cbb", RAY, t))
        return NULL;
    int64_t m = t[IMAGE].length[0], width = t[EXTERIOR].length[1];
    int fits = t[PLACE].length[0] == m && t[PLACE].length[1] == 3 && width >= 3 && t[RAY].length[0] == m &&
               t[RAY].length[1] == 2 && t[IN_CAMERA].length[0] == m && t[IN_CAMERA].length[1] == 3 &&
               t[ROTATION].length[0] == t[EXTERIOR].length[0];
    for (int64_t i = 0; fits && i < m; i++) {
        int64_t image = INTEGERS(t[IMAGE])[i];
        double vector[3], p[3];
        for (int k = 0; k < 3; k++)
            vector[k] = DOUBLES(t[VALUES])[INTEGERS(t[PLACE])[3 * i + k]] -
                        DOUBLES(t[VALUES])[INTEGERS(t[EXTERIOR])[width * image + k]];
        for (int k = 0; k < 3; k++)
            p[k] = element(&t[ROTATION], image, k, 0) * vector[0] + element(&t[ROTATION], image, k, 1) * vector[1] +
                   element(&t[ROTATION], image, k, 2) * vector[2];
        double depth = p[2] == 0.0 ? 1.0 : p[2];
        for (int k = 0; k < 3; k++)
            *place_of(&t[IN_CAMERA], i, k) = p[k];
        for (int k = 0; k < 2; k++)
            *place_of(&t[RAY], i, k) = -p[k] / depth;
    }
    close_tables(t, TABLES);
    return none_if(fits, "the sizes of targets do not go together");
}

/* target_derivatives(rows, image, rotation, attitude, ray, in_camera, by_ray, exterior, place, camera, first, derivatives)
 *
 * Fill derivatives (n, 2, k) at rows (m,). The first columns are those with respect to the given elements of exterior
 * orientation (projection centre, attitude), then to the given object coordinates. The derivatives with respect to the
 * camera (c, 2, m) follow from column first (1,) on. by_ray (m, 2, 2).
 */
static PyObject *target_derivatives(PyObject *module, PyObject *args)
{
    enum { ROWS, IMAGE, ROTATION, ATTITUDE, RAY, IN_CAMERA, BY_RAY, EXTERIOR, PLACE, CAMERA, FIRST, INTO, TABLES };
    Table t[TABLES] = {0};
    if (!open_tables(args, "11ccbbc11c13", INTO, t))
        return NULL;
    int64_t m = t[ROWS].length[0], exterior = t[EXTERIOR].length[0], place = t[PLACE].length[0];
    int64_t camera = t[CAMERA].length[0], width = t[INTO].length[2];
    int fits = t[IMAGE].length[0] == m && t[RAY].length[0] == m && t[IN_CAMERA].length[0] == m &&
               t[BY_RAY].length[0] == m && t[ATTITUDE].length[0] == t[ROTATION].length[0] &&
               (camera == 0 || t[CAMERA].length[2] == m) && t[FIRST].length[0] == 1 &&
               exterior + place <= width && INTEGERS(t[FIRST])[0] + camera <= width && t[INTO].length[1] == 2 &&
               t[RAY].length[1] == 2 && t[IN_CAMERA].length[1] == 3;
    for (int64_t i = 0; fits && i < m; i++) {
        int64_t image = INTEGERS(t[IMAGE])[i], row = INTEGERS(t[ROWS])[i];
        double p[3] = {element(&t[IN_CAMERA], i, 0, 0), element(&t[IN_CAMERA], i, 1, 0), element(&t[IN_CAMERA], i, 2, 0)};
        for (int axis = 0; axis < 2; axis++) {
            double *into = DOUBLES(t[INTO]) + (2 * row + axis) * width;
            double x = element(&t[BY_RAY], i, axis, 0) / -p[2], y = element(&t[BY_RAY], i, axis, 1) / -p[2];
            double z = x * element(&t[RAY], i, 0, 0) + y * element(&t[RAY], i, 1, 0);
            double about[3] = {p[1] * z - p[2] * y, p[2] * x - p[0] * z, p[0] * y - p[1] * x};
            double by[6];
            for (int k = 0; k < 3; k++) {
                by[k] = x * element(&t[ROTATION], image, 0, k) + y * element(&t[ROTATION], image, 1, k) +
                        z * element(&t[ROTATION], image, 2, k);
                by[3 + k] = about[0] * element(&t[ATTITUDE], image, 0, k) +
                            about[1] * element(&t[ATTITUDE], image, 1, k) +
                            about[2] * element(&t[ATTITUDE], image, 2, k);
            }
            for (int64_t k = 0; k < exterior; k++) {
                int64_t member = INTEGERS(t[EXTERIOR])[k];
                into[k] = member < 3 ? -by[member] : by[member];
            }
            for (int64_t k = 0; k < place; k++)
                into[exterior + k] = by[INTEGERS(t[PLACE])[k]];
            for (int64_t k = 0; k < camera; k++)
                into[INTEGERS(t[FIRST])[0] + k] = element(&t[CAMERA], k, axis, i);
        }
    }
    close_tables(t, TABLES);
    return none_if(fits, "the sizes of targets and derivatives do not go together");
}

/* whiten_rows(by_observation, covariance, differences, root, rows, right) -> None
 *
 * Whiten pairs of rows. Fills root (n, 2, 2): L of A C A' = L L', and right (n, 2): L^-1 A v; multiplies rows (n, 2, k)
 * by L^-1 in place.
 */
static PyObject *whiten_rows(PyObject *module, PyObject *args)
{
    enum { A, COVARIANCE, V, ROOT, ROWS, RIGHT, TABLES };
    Table t[TABLES] = {0};
    if (!open_tables(args, "ccb332", ROOT, t))
        return NULL;
    int64_t n = t[A].length[0], width = t[ROWS].length[2];
    int fits = t[COVARIANCE].length[0] == n && t[V].length[0] == n && t[ROOT].length[0] == n &&
               t[ROWS].length[0] == n && t[RIGHT].length[0] == n && t[A].length[1] == 2 && t[A].length[2] == 2;
    for (int64_t i = 0; fits && i < n; i++) {
        double a00 = element(&t[A], i, 0, 0), a01 = element(&t[A], i, 0, 1);
        double a10 = element(&t[A], i, 1, 0), a11 = element(&t[A], i, 1, 1);
        double c00 = element(&t[COVARIANCE], i, 0, 0), c01 = element(&t[COVARIANCE], i, 0, 1);
        double c10 = element(&t[COVARIANCE], i, 1, 0), c11 = element(&t[COVARIANCE], i, 1, 1);
        double x0 = a00 * c00 + a01 * c10, x1 = a00 * c01 + a01 * c11;
        double y0 = a10 * c00 + a11 * c10, y1 = a10 * c01 + a11 * c11;
        double v0 = element(&t[V], i, 0, 0), v1 = element(&t[V], i, 1, 0);
        double *root = DOUBLES(t[ROOT]) + 4 * i, *right = DOUBLES(t[RIGHT]) + 2 * i;
        root[0] = sqrt(x0 * a00 + x1 * a01);
        root[1] = 0.0;
        root[2] = (y0 * a00 + y1 * a01) / root[0];
        root[3] = sqrt(y0 * a10 + y1 * a11 - root[2] * root[2]);
        right[0] = (a00 * v0 + a01 * v1) / root[0];
        right[1] = (a10 * v0 + a11 * v1 - root[2] * right[0]) / root[3];
        double *first = DOUBLES(t[ROWS]) + 2 * i * width, *second = first + width;
        double over_first = 1.0 / root[0], over_second = 1.0 / root[3];
        for (int64_t k = 0; k < width; k++) {
            first[k] *= over_first;
            second[k] = (second[k] - root[2] * first[k]) * over_second;
        }
    }
    close_tables(t, TABLES);
    return none_if(fits, "the sizes of rows do not go together");
}

/* Cells of the bounding box of one part of a drawing: the sum of each row up to a cell is the area covered in it. */
typedef struct {
    double *areas;
    Py_ssize_t row, column, tall, wide, rows, columns;
} Box;

static Py_ssize_t within(Py_ssize_t index, Py_ssize_t size)
{
    return index < 0 ? 0 : index < size ? index : size - 1;
}

/* Cut a line of an outline at the rows (axis 1) and columns (axis 0) of cells, and add the area right of each piece. */
static void add_line(Box *box, const double *start, const double *end, int axis)
{
    double first = floor(start[axis]), along = end[axis] - start[axis], from[2] = {start[0], start[1]}, to[2];
    Py_ssize_t pieces = (Py_ssize_t)fabs(floor(end[axis]) - first) + 1;
    for (Py_ssize_t i = 1; i <= pieces; i++) {
        to[0] = end[0], to[1] = end[1];
        if (i < pieces) {
            double crossing = first + (double)(along >= 0.0 ? i : 1 - i), share = (crossing - start[axis]) / along;
            to[!axis] = start[!axis] + share * (end[!axis] - start[!axis]);
            to[axis] = crossing;
        }
        double tall = to[1] - from[1], middle = (from[0] + to[0]) / 2.0;
        Py_ssize_t row = (Py_ssize_t)floor((from[1] + to[1]) / 2.0), column = (Py_ssize_t)floor(middle);
        if (axis) {
            add_line(box, from, to, 0);
        } else if (row >= 0 && row < box->rows && column < box->columns) {
            double own = tall * (column < 0 ? 1.0 : (double)column + 1.0 - middle), *cell = box->areas;
            cell += within(row - box->row, box->tall) * (box->wide + 1) + within(column - box->column, box->wide);
            cell[0] += own;
            cell[1] += tall - own;
        }
        from[0] = to[0], from[1] = to[1];
    }
}

/* cover_cells(start, end, first, covered, columns) -> None
 *
 * Add the parts of a drawing to the covered fractions (rows, columns) of cells, single precision. start, end (n, 2):
 * lines of the outlines, column first; first (parts + 1): number of each part's first line.
 */
static PyObject *cover_cells(PyObject *module, PyObject *args)
{
    Py_buffer start, end, first, covered;
    Py_ssize_t columns;
    if (!PyArg_ParseTuple(args, "y*y*y*w*n", &start, &end, &first, &covered, &columns))
        return NULL;
    Py_ssize_t parts = first.len / (Py_ssize_t)sizeof(int64_t) - 1, width = columns > 0 ? columns : 1;
    Py_ssize_t rows = covered.len / (Py_ssize_t)sizeof(float) / width;
    const int64_t *line = first.buf;
    double *areas = malloc(sizeof(double) * (size_t)(rows * (width + 1) + 1));
    int fits = areas && columns > 0 && start.len == end.len && parts >= 0 && rows * width * 4 == covered.len &&
               line[parts] * 16 == start.len;
    for (Py_ssize_t part = 0; fits && part < parts; part++) {
        double least[2] = {INFINITY, INFINITY}, most[2] = {-INFINITY, -INFINITY};
        const double *from = (const double *)start.buf + 2 * line[part], *to = (const double *)end.buf + 2 * line[part];
        Py_ssize_t count = line[part + 1] - line[part];
        for (Py_ssize_t i = 0; i < 2 * count; i++) {
            least[i % 2] = fmin(least[i % 2], from[i]);
            most[i % 2] = fmax(most[i % 2], from[i]);
        }
        if (!(most[0] >= least[0] && least[0] < (double)width && least[1] < (double)rows && most[1] >= 0.0))
            continue;
        Box box = {areas, (Py_ssize_t)fmax(floor(least[1]), 0.0), (Py_ssize_t)fmax(floor(least[0]), 0.0), 0, 0, rows, width};
        box.tall = (Py_ssize_t)fmin(floor(most[1]) + 1.0, (double)rows) - box.row;
        box.wide = (Py_ssize_t)fmax(fmin(floor(most[0]) + 1.0, (double)width) - (double)box.column, 1.0);
        memset(areas, 0, sizeof(double) * (size_t)(box.tall * (box.wide + 1)));
        for (Py_ssize_t i = 0; i < count; i++)
            add_line(&box, from + 2 * i, to + 2 * i, 1);
        for (Py_ssize_t row = 0; row < box.tall; row++) {
            float *about = (float *)covered.buf + (box.row + row) * width + box.column;
            double area = 0.0;
            for (Py_ssize_t column = 0; column < box.wide; column++) {
                area += areas[row * (box.wide + 1) + column];
                about[column] += (float)((1.0f - about[column]) * fmin(fabs(area), 1.0));
            }
        }
    }
    free(areas);
    PyBuffer_Release(&start);
    PyBuffer_Release(&end);
    PyBuffer_Release(&first);
    PyBuffer_Release(&covered);
    return none_if(fits, "the sizes of lines, parts and cells do not go together");
}

/* Quotient rounded down. */
static Py_ssize_t quotient(Py_ssize_t number, Py_ssize_t by)
{
    return number / by - (number % by < 0);
}

/* blurred_images(sharp, columns, taps, shift, cells, images, width) -> None
 *
 * Blur cells (rows, columns) to images (1 or 6, height, width) in pixels of cells x cells: the value, or it and its
 * derivatives by column, row, column twice, both, row twice. taps (2, orders, taps): weights of cells along columns and
 * rows; shift (2): first cell that a tap of the window's first pixel falls on, (column, row). All in single precision.
 */
static PyObject *blurred_images(PyObject *module, PyObject *args)
{
    static const int orders_by_column[6] = {0, 1, 0, 2, 1, 0}, orders_by_row[6] = {0, 0, 1, 0, 1, 2};
    Py_buffer sharp, taps, images;
    Py_ssize_t columns, shift[2], cells, width, orders;
    if (!PyArg_ParseTuple(args, "y*ny*n(nn)nw*n", &sharp, &columns, &taps, &orders, shift, shift + 1, &cells, &images,
                          &width))
        return NULL;
    int fits = columns > 0 && (orders == 1 || orders == 3) && cells > 0 && width > 0, number = orders == 3 ? 6 : 1;
    Py_ssize_t rows = fits ? sharp.len / 4 / columns : 0, height = fits ? images.len / 4 / number / width : 0;
    Py_ssize_t reach = fits ? taps.len / 8 / orders : 0;
    float *line = malloc(sizeof(float) * (size_t)(3 * (width > 0 ? width : 1)));
    float *along = calloc((size_t)(4 * reach + 16), sizeof(float)); /* (taps, 4): orders beside each other, for vectors */
    float *padded = calloc((size_t)(fits ? columns : 0) + 4, sizeof(float)); /* a row of cells */
    fits = fits && line && along && padded && rows * columns * 4 == sharp.len && reach * orders * 8 == taps.len &&
           height * width * number * 4 == images.len;
    for (Py_ssize_t i = 0; fits && i < reach * orders; i++)
        along[4 * (i % reach) + i / reach] = ((const float *)taps.buf)[i];
    for (Py_ssize_t row = 0; row < rows && fits; row++) {
        const float *cell = (const float *)sharp.buf + row * columns, *tap = (const float *)taps.buf + orders * reach;
        Py_ssize_t begin = 0, end = columns;
        while (begin < columns && cell[begin] == 0.0f)
            begin++;
        while (end > begin && cell[end - 1] == 0.0f)
            end--;
        Py_ssize_t left = quotient(begin - shift[0] - reach, cells) + 1, right = quotient(end - 1 - shift[0], cells) + 1;
        Py_ssize_t top = quotient(row - shift[1] - reach, cells) + 1, bottom = quotient(row - shift[1], cells) + 1;
        left = left > 0 ? left : 0, right = right < width ? right : width;
        top = top > 0 ? top : 0, bottom = bottom < height ? bottom : height;
        if (begin == end || left >= right || top >= bottom)
            continue;
        memcpy(padded, cell, sizeof(float) * (size_t)columns);
        for (Py_ssize_t pixel = left; pixel < right; pixel++) {
            Py_ssize_t at = pixel * cells + shift[0], from = begin > at ? begin : at;
            Py_ssize_t to = end < at + reach ? end : at + reach;
            float sum[16] = {0.0f};
            for (Py_ssize_t i = from; i < to; i += 4) /* four sums of each, which need not wait for one another */
                for (int order = 0; order < 16; order++)
                    sum[order] += along[4 * (i - at) + order] * padded[i + order / 4];
            for (Py_ssize_t order = 0; order < orders; order++)
                line[order * width + pixel] = sum[order] + sum[order + 4] + sum[order + 8] + sum[order + 12];
        }
        for (Py_ssize_t pixel = top; pixel < bottom; pixel++)
            for (int i = 0; i < number; i++) {
                float weight = tap[orders_by_row[i] * reach + row - pixel * cells - shift[1]];
                const float *source = line + orders_by_column[i] * width;
                float *image = (float *)images.buf + (i * height + pixel) * width;
                for (Py_ssize_t column = left; column < right; column++)
                    image[column] += weight * source[column];
            }
    }
    free(line);
    free(along);
    free(padded);
    PyBuffer_Release(&sharp);
    PyBuffer_Release(&taps);
    PyBuffer_Release(&images);
    return none_if(fits, "the sizes of cells, taps and images do not go together");
}

static PyMethodDef methods[] = {
    {"cover_cells", cover_cells, METH_VARARGS, "Areas of cells that a drawing covers."},
    {"blurred_images", blurred_images, METH_VARARGS, "Blurred image of a drawing and its derivatives."},
    {"target_rays", target_rays, METH_VARARGS, "Rays of object points in images."},
    {"target_derivatives", target_derivatives, METH_VARARGS, "Derivatives of images by orientations and points."},
    {"whiten_rows", whiten_rows, METH_VARARGS, "Pairs of rows of unit weight."},
    {"border_cofactors", border_cofactors, METH_VARARGS, "Cofactors of shared unknowns through borders of blocks."},
    {"square_rows", square_rows, METH_VARARGS, "Normal equations of many pairs of rows in the unknowns they share."},
    {"eliminate_blocks", eliminate_blocks, METH_VARARGS, "Own unknowns of many blocks eliminated onto shared ones."},
    {"spline_samples", spline_samples, METH_VARARGS, "Samples of a spline at places, rounded and clamped."},
    {NULL, NULL, 0, NULL},
};

static struct PyModuleDef definition = {PyModuleDef_HEAD_INIT, "kernels", "Compiled inner loops.", -1, methods};

PyMODINIT_FUNC PyInit_kernels(void)
{
    return PyModule_Create(&definition);
}
