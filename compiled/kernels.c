/* Inner loops that numpy and scipy leave slow. Each is the compiled twin of a few lines of Python, which run where there
 * is no compiler, and is tested against them. The buffers are checked for their sizes; what they mean is the caller's.
 */
#define PY_SSIZE_T_CLEAN
#define Py_LIMITED_API 0x030B0000
#include <Python.h>
#include <math.h>
#include <stdint.h>

#define MOST_TAPS 6

/* The weights of a B-spline of degree 3 or 5 at a part t of a step behind the middle one of its first taps. */
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

/* An index mirrored at the first and the last one, once: places lie at most a few taps outside. */
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
 * Samples, 8 or 16 bits by the buffer's items, of a spline with coefficients (height, width) at places (n,), rounded to
 * even and clamped; how many were.
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
    if (!fits) {
        PyErr_SetString(PyExc_ValueError, "the sizes of coefficients, places and samples do not go together");
        return NULL;
    }
    return PyLong_FromSsize_t(clamped);
}

static PyMethodDef methods[] = {
    {"spline_samples", spline_samples, METH_VARARGS, "Samples of a spline at places, rounded and clamped."},
    {NULL, NULL, 0, NULL},
};

static struct PyModuleDef definition = {PyModuleDef_HEAD_INIT, "kernels", "Compiled inner loops.", -1, methods,
                                        NULL, NULL, NULL, NULL};

PyMODINIT_FUNC PyInit_kernels(void)
{
    return PyModule_Create(&definition);
}
